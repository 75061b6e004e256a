# SPDX-License-Identifier: Apache-2.0
"""Planners with derivatives: what they find, closed loops, feedback between plans, and what they refuse.

Slow ones by hand: pytest -m slow tests/planner/test_refine.py
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from small_scenes import compiled, make_scene

from warpmpc import Controller, Plant, SceneError, State, load_scene, run_episode
from warpmpc.loop.realtime.messages import PlanCodec, TimedPlan
from warpmpc.planner.derivatives.expansion import Linear, Quadratic, held
from warpmpc.planner.feedback import Feedback, StateSpace
from warpmpc.scene.overrides import with_values

DISC_PLANNER = {"samples": 16, "horizon": 10, "discount": 1.0, "randomize": False}
KNOTS = {"knots": "steps", "spline": "zero"}


def disc(method: str = "ilqg", **planner):
    """The disc that drives to (1, 0.5), by a cost that is quadratic in its place and its controls."""
    cost = [
        {"term": "position_residual", "of": "base/centre", "target": [1.0, 0.5], "axes": "xy"},
        {"term": "control_effort", "weight": 0.01},
    ]
    return make_scene(planner={**DISC_PLANNER, "method": method, **planner}, cost=cost, engine={"threads": 1})


def planned(scene, *, engine: str = "fused", plans: int = 1, seed: int = 0):
    """A controller after some plans from the same state, and the costs of its plans."""
    controller = Controller(scene, engine=engine, device="cpu", seed=seed, compiled=compiled(scene))
    state, costs = State.start(controller.layout), []
    for _ in range(plans):
        controller.step(replace(state, time=0.0))
        costs.append(controller.info.cost)
    return controller, costs


@pytest.mark.parametrize(
    "engine", ["fused", "mujoco", "kinematic", pytest.param("mujoco_warp", marks=pytest.mark.slow)]
)
def test_ilqg_finds_in_one_plan_what_samples_come_near_to_in_many(engine):
    _, ilqg = planned(disc(), engine=engine, plans=4)
    _, samples = planned(disc("predictive_sampling", samples=64), engine=engine, plans=30)
    assert ilqg[0] < 1.001 * min(samples)
    assert ilqg[-1] < min(samples)
    assert abs(ilqg[-1] - ilqg[-2]) < 1e-4 * ilqg[-1]


def test_gradient_descent_only_ever_improves_the_plan():
    _, costs = planned(disc("gradient_descent", knots=5, spline="linear"), plans=12)
    assert all(after <= before * (1.0 + 1e-6) for before, after in pairwise(costs))
    assert costs[-1] < 0.9 * costs[0]
    _, ilqg = planned(disc(), plans=4)
    assert costs[-1] < 1.1 * ilqg[-1]


def test_ilqs_is_no_worse_than_the_samples_alone():
    _, samples = planned(disc("predictive_sampling", **KNOTS))
    controller, refined = planned(disc("ilqs"))
    assert refined[0] < samples[0]
    assert controller.info.eta == 1.0


def test_refinement_stands_behind_any_method():
    _, plain = planned(disc("mppi"))
    _, refined = planned(disc("mppi", refine={"method": "gradient"}))
    assert refined[0] < plain[0]


def test_the_same_seed_gives_the_same_commands():
    runs = [planned(disc("ilqs"), plans=3, seed=5)[0].plan_step.strategy.mean.numpy() for _ in range(2)]
    np.testing.assert_array_equal(*runs)


def test_controls_stay_within_their_limits_and_no_gain_holds_them_there():
    scene = with_values(disc(), {"robot.base.drive.limit": [0.2, 0.2, 0.2]})
    controller, _ = planned(scene, plans=3)
    plan = controller.plan(replace(State.start(controller.layout), time=0.0))
    assert np.abs(plan.knots).max() <= 0.2
    at_limit = np.abs(plan.knots) > 0.2 - 1e-6
    assert at_limit.any()
    assert np.abs(plan.feedback.gain[0][~at_limit]).max() > 0.0


def test_a_plan_answers_a_state_that_is_not_the_planned_one():
    controller, _ = planned(disc(), plans=3)
    near = np.float32([0.9, 0.45, 0.0])  # where no control is at its limit
    state = replace(State.start(controller.layout), time=0.0, joint_q=near)
    for _ in range(3):
        plan = controller.plan(state)
    later = 0.06
    wanted, _ = plan.feedback.at(np.array([[later]]))
    found = wanted[0, 0].astype(np.float32)
    on_plan = replace(state, joint_q=found[:3], joint_qd=found[3:6], time=later)
    np.testing.assert_allclose(plan.at(later, on_plan), plan.at(later), atol=1e-4)
    pushed = replace(on_plan, joint_q=on_plan.joint_q + np.float32([0.0, 0.05, 0.0]))
    answer = plan.at(later, pushed) - plan.at(later)
    assert answer[1] < -0.01  # it was pushed to the left, and goes back
    np.testing.assert_array_equal(plan.at(later, pushed), plan.at(later, pushed))
    assert np.abs(plan.at(later, replace(pushed, joint_q=pushed.joint_q + 100.0))).max() <= 1.0
    # what is seen late is compared with what was planned for then
    np.testing.assert_allclose(plan.at(later + 0.04, on_plan), plan.at(later + 0.04), atol=1e-4)
    for outside in (-1.0, float(plan.times[-1]) + 10.0):
        np.testing.assert_array_equal(plan.at(outside, pushed), plan.at(outside))
        apart = replace(pushed, time=outside)
        np.testing.assert_array_equal(plan.at(later, apart), plan.at(later))


def test_every_environment_has_its_own_plan():
    scene = disc()
    both = Controller(scene, engine="fused", device="cpu", envs=2, compiled=compiled(scene))
    start = State.start(both.layout)
    q = np.stack([start.joint_q, start.joint_q + np.float32([0.4, -0.3, 0.2])])
    command = both.step(State(q, np.zeros_like(q), 0.0))
    for e in range(2):
        alone = Controller(scene, engine="fused", device="cpu", compiled=compiled(scene))
        np.testing.assert_array_equal(command[e], alone.step(State(q[e], np.zeros(3, np.float32), 0.0)))


@pytest.mark.usefixtures("optimized")
@pytest.mark.parametrize("method", ["ilqg", "ilqs", "gradient_descent"])
def test_a_pole_is_swung_up(method):
    scene = with_values(load_scene("cartpole_swingup"), {"planner.method": method, "engine.threads": 1})
    result = run_episode(scene, engine="fused", device="cpu", seed=3)
    assert result.success
    assert result.sim_time < 8.0


HELD = {
    "planner.method": "ilqg",
    "planner.horizon": 60,
    "planner.dt": [0.02],
    "engine.threads": 1,
    "engine.substeps": 2,
    "planner.spline": "linear",
    "plant.substeps": 1,
    "timing.control_dt": 0.002,
    "robot.cart.joint_q": [0.0, 0.02],
    "cost": [
        {"term": "position_residual", "of": "cart/tip", "target": [0.0, 1.0], "axes": "xz", "weight": 10.0},
        {"term": "joint_velocity", "weight": 0.05},
        {"term": "control_effort", "weight": 0.05},
    ],
}
"""A pole that stands, under 500 controls a second."""


@pytest.mark.parametrize("push", [-0.35, 0.4])  # at -0.4 it ends at a lean of 0.5 rad by rounding
def test_gains_hold_between_slow_plans_what_falls_without_them(push):
    kicks = [{"time": t, "target": "cart", "velocity": [0.0, push]} for t in (0.6, 1.6)]
    scene = with_values(load_scene("cartpole_swingup"), {**HELD, "plant.kicks": kicks})
    upright = []
    for feedback in (True, False):
        controller, plant = Controller(scene, engine="fused", device="cpu"), Plant(scene)
        for tick in range(1200):
            state = plant.observe()
            if tick % 250 == 0:  # two plans a second
                plan = controller.plan(state)
            plant.apply(plan.at(state.time, state if feedback else None))
        upright.append(bool(np.cos(plant.observe().joint_q[1]) > 0.9))
    assert upright == [True, False]


@pytest.mark.parametrize("dt", [0.01, 0.02, 0.025, 0.04])
def test_a_plan_is_followed_from_the_step_that_time_has_come_to(dt):
    steps = np.arange(8)
    gain = steps.reshape(1, 8, 1, 1) * np.ones((1, 8, 1, 2))
    space = StateSpace.of(compiled(load_scene("cartpole_swingup")))
    feedback = Feedback(dt * steps[None], np.zeros((1, 8, 4)), gain, space)
    times = np.float32(dt).astype(float) + dt * steps[None]  # what has passed is known in single precision
    np.testing.assert_array_equal(feedback.planned(times, steps.reshape(1, 8, 1))[0, :, 0], [1, 2, 3, 4, 5, 6, 7, 7])
    np.testing.assert_array_equal(feedback.at(times)[1][0, :7, 0, 0], [1, 2, 3, 4, 5, 6, 7])


def test_samples_do_not_replace_a_plan_that_holds_what_is_unstable():
    values = {**HELD, "planner.method": "ilqs", "planner.samples": 16, "planner.horizon": 120}
    controller = Controller(with_values(load_scene("cartpole_swingup"), values), engine="fused", device="cpu")
    costs = []
    for lean in [0.0] * 3 + [0.005] * 12:  # [rad] in 2.4 s it falls from there, unless the old plan's gains are asked
        joint_q = np.float32([0.0, lean])
        controller.plan(replace(State.start(controller.layout), time=0.0, joint_q=joint_q))
        costs.append(controller.info.cost)
    assert costs[3] < 1.2 * costs[-1]


@pytest.mark.parametrize(
    ("engine", "values", "says"),
    [
        ("mujoco", {"planner.dt": [0.04] * 9 + [0.08]}, r"planner\.dt: .* one length"),
        (
            "mujoco",
            {"planner.method": "gradient_descent", "planner.samples": 4},
            r"planner\.samples: .* 8 candidates",
        ),
    ],
)
def test_what_cannot_be_differentiated_is_refused_by_name(engine, values, says):
    scene = with_values(make_scene(planner={**DISC_PLANNER, "method": "ilqg"}), values)
    with pytest.raises(SceneError, match=says):
        Controller(scene, engine=engine, device="cpu", compiled=compiled(scene))


@pytest.mark.parametrize(("method", "level"), [("ilqg", "WARNING"), ("auto", "DEBUG")])  # those of auto nobody asks for
def test_a_plan_that_derivatives_fail_for_stays_as_the_samples_left_it(method, level, caplog):
    caplog.set_level("DEBUG", "warpmpc")
    controller, _ = planned(disc("mppi", samples=256, refine={"method": method}, **KNOTS))
    controller.plan_step.refiner.differences._moves.state.fill_(np.nan)
    command = controller.step(replace(State.start(controller.layout), time=0.04))
    assert np.isfinite(command).all()
    assert [r.levelname for r in caplog.records if "no derivatives" in r.message] == [level]
    assert controller.plan_step.feedback is None


def test_check_says_which_terms_have_no_residual():
    cost = [
        {"term": "distance", "between": ["base/centre", "goal"]},
        {"term": "contact_force", "between": ["robots", "obstacles"]},
    ]
    scene = disc().model_copy(update={"cost": make_scene(cost=cost).cost})
    controller, _ = planned(scene)
    worlds = 10 * (1 + 2 * (6 + 3))
    assert controller.plan_step.refiner.summary.startswith(f"differences of 3 residuals in {worlds} worlds")
    assert controller.plan_step.refiner.summary.endswith("rough Hessian: contact_force")


def test_feedback_crosses_processes_as_numbers():
    scene = disc()
    controller, _ = planned(scene, plans=2)
    state = replace(State.start(controller.layout), time=0.0, joint_q=np.float32([0.9, 0.45, 0.0]))
    plan = controller.plan(state)
    codec = PlanCodec(controller.layout, len(plan.times), StateSpace.of(controller.compiled))
    letter = codec.encode(TimedPlan(plan, 3, 0.0, 0.01, 5.0, True))
    assert len(letter) == codec.capacity
    told = codec.decode(letter)
    assert told.number == 3
    pushed = replace(state, time=0.05, joint_q=state.joint_q + np.float32([0.01, -0.02, 0.1]))
    assert np.abs(plan.at(0.05, pushed) - plan.at(0.05)).max() > 1e-3
    np.testing.assert_array_equal(told.plan.at(0.05, pushed), plan.at(0.05, pushed))


def test_limits_that_change_hold_for_derivatives_too():
    controller, _ = planned(disc(), plans=2)
    controller.set_limits(np.full(3, -0.3), np.full(3, 0.3))
    plan = controller.plan(replace(State.start(controller.layout), time=0.0))
    assert 0.29 < np.abs(plan.knots).max() <= np.float32(0.3)


def test_feedback_goes_by_clocks_that_began_long_ago():
    commands = []
    for start in (0.0, 1.7e9):
        controller, _ = planned(disc())
        controller.reset()
        near = replace(State.start(controller.layout), joint_q=np.float32([0.9, 0.45, 0.0]))
        for k in range(3):
            plan = controller.plan(replace(near, time=start + 0.04 * k))
        pushed = replace(near, joint_q=np.float32([0.85, 0.5, 0.1]))
        commands.append(plan.at(start + 0.1, pushed))
        assert np.abs(commands[-1] - plan.at(start + 0.1)).max() > 1e-2
    np.testing.assert_allclose(*commands, atol=1e-4)


def test_controls_are_held_for_as_long_as_they_are_sent():
    values = {"planner.horizon": 20, "planner.dt": [0.02], "planner.spline": "zero"}
    fine = with_values(disc(), values)
    assert fine.timing.control_dt == pytest.approx(0.04)
    controller, costs = planned(fine, engine="mujoco", plans=4)
    assert controller.plan_step.strategy.mean.shape[1] == 10
    sent = controller.plan_step.engine.recorded.control.numpy()[:, 0]
    np.testing.assert_array_equal(sent[::2], sent[1::2])
    _, free = planned(with_values(fine, {"timing.control_dt": 0.02}), engine="mujoco", plans=4)
    assert free[-1] <= costs[-1] < 1.05 * free[-1]  # a control for every step can do no worse


def test_steps_under_one_control_are_one_step():
    """Against the chain of single steps in float64, the last control held for one step alone."""
    rng = np.random.default_rng(0)
    steps, n, nu = 5, 3, 2

    def draw(*shape):
        return rng.standard_normal((1, steps, *shape))

    linear = Linear(draw(n, n), draw(n, nu), draw(0), draw(0, n), draw(0, nu))
    half = draw(n + nu, n + nu)
    whole = half @ half.swapaxes(-1, -2)
    cost = Quadratic(draw(n), draw(nu), whole[..., :n, :n], whole[..., n:, :n], whole[..., n:, n:])
    together, total = held(linear, cost, 2)

    def roll(start, controls, first, count):
        """What some steps cost from a state, and the state after them."""
        x, spent = start, 0.0
        for t in range(first, first + count):
            z = np.concatenate([x, controls])
            spent += cost.x[0, t] @ x + cost.u[0, t] @ controls + 0.5 * z @ whole[0, t] @ z
            x = linear.a[0, t] @ x + linear.b[0, t] @ controls
        return spent, x

    for block, (first, count) in enumerate([(0, 2), (2, 2), (4, 1)]):
        x, u = rng.standard_normal(n), rng.standard_normal(nu)
        spent, end = roll(x, u, first, count)
        np.testing.assert_allclose(together.a[0, block] @ x + together.b[0, block] @ u, end)
        xx, ux, uu = (m[0, block] for m in (total.xx, total.ux, total.uu))
        model = total.x[0, block] @ x + total.u[0, block] @ u + 0.5 * x @ xx @ x + u @ ux @ x + 0.5 * u @ uu @ u
        np.testing.assert_allclose(model, spent)
