# SPDX-License-Identifier: Apache-2.0
"""A plan's rollouts as arrays, and a controller that goes on from a plan it is given."""

import numpy as np
import pytest
from small_scenes import compiled, make_scene

from warpmpc import Controller, Plan, State


def make_controller(*, seed: int = 0, envs: int = 1, **planner) -> Controller:
    scene = make_scene(planner={"samples": 16, "horizon": 4, **planner})
    return Controller(scene, seed=seed, envs=envs, compiled=compiled(scene))


def start(controller: Controller, time: float = 0.0) -> State:
    return State(controller.layout.joint_q, controller.layout.joint_qd, time=time)


def test_the_best_rollout_is_the_one_the_plan_reports():
    controller = make_controller(spline="cubic", knots=3)
    with pytest.raises(ValueError, match="nothing has been planned yet"):
        controller.rollout()
    controller.step(start(controller, time=2.0))
    best, layout = controller.rollout(), controller.layout
    assert best.cost == pytest.approx(controller.info.cost)
    np.testing.assert_allclose(best.times, 2.0 + 0.04 * np.arange(5))
    assert best.control.shape == (4, layout.nu)
    assert best.knots.shape == (3, layout.nu)
    np.testing.assert_array_equal(best.joint_q[0], layout.joint_q)
    # the disc moves as its joints say, and its controls are the spline of its knots
    np.testing.assert_allclose(best.frame("base/centre")[:, :2], best.joint_q[:, :2], atol=1e-6)
    lifted = best.frame("base/tip")[:, :2] - best.frame("base/centre")[:, :2]
    np.testing.assert_allclose(np.linalg.norm(lifted, axis=1), 0.2, atol=1e-6)
    knots = Plan(
        best.knots,
        2.0 + 0.06 * np.arange(3),
        controller.plan_step.plan_spline.kind,
        *[np.full(3, s) for s in (-1.0, 1.0)],
    )
    np.testing.assert_allclose(best.control, [knots.at(t) for t in best.times[:-1]], atol=1e-5)
    others = [controller.rollout(s).cost for s in range(16)]
    assert best.cost == min(others)
    with pytest.raises(ValueError, match="pose of the task"):
        best.frame("goal")
    with pytest.raises(ValueError, match="16 samples"):
        controller.rollout(16)


def test_a_rollout_is_of_the_environment_that_is_asked_for():
    controller = make_controller(envs=2)
    q = np.stack([controller.layout.joint_q, controller.layout.joint_q + (0.5, 0.0, 0.0)])
    controller.step(State(q, np.zeros_like(q)))
    assert [controller.rollout(e=e).joint_q[0, 0] for e in (0, 1)] == [0.0, 0.5]
    assert [controller.rollout(e=e).cost for e in (0, 1)] == pytest.approx([info.cost for info in controller.info])


def narrow(**keys) -> Controller:
    """A controller whose plans stay what they were: its samples hardly differ from the mean."""
    return make_controller(noise={"sigma": 1e-6, "null_sample": False}, **keys)


@pytest.mark.parametrize("kind", ["zero", "linear", "cubic", "bspline"])
def test_a_controller_goes_on_from_a_plan_on_the_clock_of_its_observations(kind):
    other = make_controller(spline=kind, horizon=8, knots="steps" if kind == "zero" else 5)
    plan = other.plan(start(other, time=1.0))
    assert np.ptp(plan.knots) > 0.05
    first, second = (narrow(spline=kind, horizon=8, knots="steps" if kind == "zero" else 5) for _ in range(2))
    first.step(start(first))
    first.reset(plan=plan)
    same = first.plan(start(first, time=1.0))
    np.testing.assert_allclose(same.knots, plan.knots, atol=1e-4)
    second.reset(plan=same)
    # from there on it is as if it had made that plan itself
    on, later = (mpc.plan(start(mpc, time=1.1)) for mpc in (first, second))
    assert np.abs(on.knots - plan.knots).max() > 0.01
    np.testing.assert_allclose(later.knots, on.knots, atol=1e-4)
    np.testing.assert_allclose(later.times, on.times)
    second.reset()
    assert np.abs(second.plan(start(second, time=1.1)).knots).max() < 1e-3


def test_a_plan_of_other_knots_is_fitted_and_one_of_other_controls_refused():
    other = make_controller(spline="linear", horizon=8, knots=3)
    plan = other.plan(start(other))
    mpc = narrow(spline="linear", horizon=8, knots=5)
    mpc.reset(plan=plan)
    fitted = mpc.plan(start(mpc))
    np.testing.assert_allclose([fitted.at(t) for t in fitted.times], [plan.at(t) for t in fitted.times], atol=1e-4)
    few = Plan(plan.knots[:, :2], plan.times, plan.spline, plan.lower[:2], plan.upper[:2])
    with pytest.raises(ValueError, match="a plan here is of 3 controls"):
        mpc.reset(plan=few)


def test_without_times_the_next_observation_comes_one_control_after_the_plan():
    other = make_controller(spline="linear", horizon=8)
    plan = other.plan(start(other, time=5.0))
    mpc = narrow(spline="linear", horizon=8)
    mpc.reset(plan=plan)
    u = mpc.step(State(mpc.layout.joint_q, mpc.layout.joint_qd))
    np.testing.assert_allclose(u, plan.at(5.04), atol=1e-3)
