# SPDX-License-Identifier: Apache-2.0
"""Plans as they are handed out: the kernels' splines on the host, absolute times, and nothing that changes later."""

import dataclasses

import numpy as np
import pytest
import warp as wp
from small_scenes import compiled, make_scene

from warpmpc import Controller, Plan, State
from warpmpc.kernels.planner.splines import command_kernel
from warpmpc.planner.splines import SplineKind, spline_table

EVEN = 0.1 * np.arange(7)
UNEVEN = np.array([0.0, 0.1, 0.25, 0.3, 0.7, 0.9, 1.6])
FREE = {"lower": np.full(2, -1e6), "upper": np.full(2, 1e6)}


def by_kernel(kind: SplineKind, times: np.ndarray, knots: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Values ``[n, nu]`` of a spline over knots [P, nu] by the kernel that commands."""
    spline = spline_table(kind, times, 0.1, "cpu")
    mean = wp.array(np.repeat(knots[None], len(at), axis=0), dtype=float, device="cpu")
    out = wp.zeros((len(at), knots.shape[1]), dtype=float, device="cpu")
    limits = [wp.array(FREE[side], dtype=float, device="cpu") for side in ("lower", "upper")]
    offset = wp.array(at, dtype=float, device="cpu")
    wp.launch(command_kernel, dim=out.shape, inputs=[mean, spline, *limits, offset], outputs=[out], device="cpu")
    return out.numpy()


@pytest.mark.parametrize("times", [EVEN, UNEVEN, EVEN[:2], EVEN[:1]], ids=["even", "uneven", "two", "one"])
@pytest.mark.parametrize("kind", list(SplineKind))
@pytest.mark.parametrize("seed", range(2))
def test_a_plan_is_the_spline_of_the_kernels(kind, times, seed):
    rng = np.random.default_rng(seed)
    knots = rng.normal(size=(len(times), 2)).astype(np.float32)
    at = rng.uniform(-0.3, times[-1] + 0.3, size=200)
    if kind is SplineKind.ZERO:  # it jumps at its knots: stay off the rounding error around them
        at = at[np.abs(at[:, None] - times).min(axis=1) > 1e-3]
    plan = Plan(knots, times + 3.0, kind, **FREE)
    found = np.array([plan.at(3.0 + t) for t in at])
    np.testing.assert_allclose(found, by_kernel(kind, times, knots, at), atol=1e-6)


@pytest.mark.parametrize("kind", list(SplineKind))
def test_at_a_knot_a_plan_is_what_the_kernel_says_though_times_round(kind):
    knots = np.random.default_rng(0).normal(size=(7, 2)).astype(np.float32)
    plan = Plan(knots, 12345.6 + EVEN, kind, **FREE)
    for j in range(7):
        expected = by_kernel(kind, EVEN, knots, EVEN[j : j + 1])[0]
        np.testing.assert_allclose(plan.at(12345.6 + 0.1 * j), expected, atol=1e-5)


def test_controls_are_within_the_limits():
    plan = Plan(np.array([[0.0], [0.0], [1.0], [1.0]]), np.arange(4.0), SplineKind.CUBIC, np.zeros(1), np.ones(1))
    assert plan.at(2.4) == 1.0
    assert plan.at(0.6) == 0.0


def test_every_environment_has_times_of_its_own():
    knots = np.random.default_rng(1).normal(size=(2, 7, 2)).astype(np.float32)
    times = np.stack([EVEN, EVEN + 4.0])
    plan = Plan(knots, times, SplineKind.LINEAR, **FREE)
    alone = [Plan(knots[e], times[e], SplineKind.LINEAR, **FREE) for e in range(2)]
    np.testing.assert_array_equal(plan.at(np.array([0.33, 4.2])), [alone[0].at(0.33), alone[1].at(4.2)])
    np.testing.assert_array_equal(plan.at(4.2), [alone[0].at(4.2), alone[1].at(4.2)])


@pytest.mark.parametrize("envs", [1, 2])
@pytest.mark.parametrize(
    "keys", [{}, {"spline": "cubic", "knots": 4}, {"knots": 3}, {"dt": {"first": 0.04, "last": 0.12}}]
)
def test_a_plan_at_the_time_of_the_state_is_the_step_of_a_twin(keys, envs):
    if "dt" in keys:  # multiples of the physics step
        keys = {"dt": (0.04, 0.04, 0.08, 0.08, 0.12, 0.12), "spline": "linear"}
    scene = make_scene(planner={"samples": 16, "horizon": 6, **keys})
    planner, twin = (Controller(scene, envs=envs, seed=5, compiled=compiled(scene)) for _ in range(2))
    q, qd = np.zeros((envs, 3), np.float32), np.zeros((envs, 3), np.float32)
    plans = []
    for time in (7.0, 7.04, 7.06, 7.2, 7.24):
        state = State(q, qd, time)
        plan = planner.plan(state)
        np.testing.assert_allclose(plan.at(time), twin.step(state), atol=2e-6)
        assert plan.times.shape == (envs, len(planner.plan_step.plan_spline.times))
        np.testing.assert_allclose(
            np.diff(plan.times), np.tile(np.diff(planner.plan_step.plan_spline.times), (envs, 1))
        )
        assert np.all((plan.times[:, 0] <= time + 1e-6) & (plan.times[:, 0] > time - 0.1))
        q = q + 0.02
        plans.append((plan, plan.knots.copy(), plan.times.copy()))
    for plan, knots, times in plans:  # the planner went on, these stay what they were
        np.testing.assert_array_equal(plan.knots, knots)
        np.testing.assert_array_equal(plan.times, times)


def test_a_plan_cannot_be_changed():
    plan = Plan(np.zeros((2, 1)), np.arange(2.0), SplineKind.ZERO, np.zeros(1), np.ones(1))
    with pytest.raises(dataclasses.FrozenInstanceError):
        plan.knots = np.ones((2, 1))


def test_a_plan_keeps_the_limits_it_was_made_with():
    scene = make_scene(planner={"samples": 8, "horizon": 4})
    controller = Controller(scene, compiled=compiled(scene))
    state = State(np.zeros(3, np.float32), np.zeros(3, np.float32), 0.0)
    plan = controller.plan(state)
    before = plan.at(0.0)
    controller.set_limits(np.full(3, -1e-3), np.full(3, 1e-3))
    np.testing.assert_array_equal(plan.at(0.0), before)
    assert plan.times.shape == (4,)
    assert np.abs(controller.plan(state).at(0.0)).max() <= 1e-3 + 1e-9


@pytest.mark.parametrize("covariance", ["diagonal", "full"])
@pytest.mark.parametrize("share", [0.1, 3.0])
def test_samples_follow_limits_that_changed(covariance, share):
    planner = {"samples": 64, "horizon": 4, "covariance": {"form": covariance}, "noise": {"sigma": 5.0}}
    scene = make_scene(planner=planner)
    controller = Controller(scene, compiled=compiled(scene))
    state = State(np.zeros(3, np.float32), np.zeros(3, np.float32), 0.0)
    controller.plan(state)
    upper = share * controller.limits[1]
    controller.set_limits(-upper, upper)
    controller.plan(state)
    for largest in ([r.knots, r.control] for r in map(controller.rollout, range(1, 64))):
        assert all(np.abs(values).max() <= upper.max() * (1.0 + 1e-6) for values in largest)
    reached = max(np.abs(controller.rollout(i).knots / upper).max() for i in range(1, 64))
    assert reached == pytest.approx(1.0)
