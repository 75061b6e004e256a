# SPDX-License-Identifier: Apache-2.0
"""The plan step on a real small scene: every method improves its plan, the same way every time."""

import numpy as np
import pytest
from planning import Planning
from small_scenes import BOX, DISC, compiled

from warpmpc import SceneError
from warpmpc.planner.step import PlanStep

METHODS = {
    "mppi": {"method": "mppi", "temperature": {"initial": 0.05}},
    "mppi ess": {"method": "mppi", "temperature": {"ess": 5.0}},
    "predictive_sampling": {"method": "predictive_sampling"},
    "cem": {"method": "cem", "elites": 6, "sigma_min": (0.05,)},
    "tsallis": {"method": "tsallis", "elites": 6},
}
ANNEALED = {"dial": {"method": "dial", "temperature": {"initial": 0.05}}}
GOAL = np.array([1.0, 0.5])
WIDE = {**DISC, "drive": {**DISC["drive"], "limit": (9.0, 9.0, 9.0)}}


@pytest.mark.parametrize("name", METHODS)
def test_the_mean_moves_towards_the_optimum(name):
    ratio = []
    for seed in (2, 1, 0):
        planning = Planning(planner=METHODS[name], seed=seed)
        planning()
        at_rest = planning.cost[0, 0]
        commands = planning(12)
        # sample 0 is the mean: the plan itself has become cheap
        ratio.append(planning.cost[0, 0] / at_rest)
    assert np.mean(ratio) < 0.92
    direction = commands[-4:, 0, :2].mean(axis=0)
    assert direction @ GOAL / np.linalg.norm(direction) / np.linalg.norm(GOAL) > 0.9
    assert np.linalg.norm(direction) > 0.6
    assert np.all(np.abs(commands) <= 1.0)


@pytest.mark.parametrize("name", METHODS)
def test_the_same_seed_plans_the_same(name):
    first, again, other = (Planning(planner=METHODS[name], seed=seed) for seed in (1, 1, 2))
    commands = first(10)
    np.testing.assert_array_equal(commands, again(10))
    assert not np.array_equal(commands, other(10))
    np.testing.assert_array_equal(first.mean, again.mean)
    first.plan.reset()
    np.testing.assert_array_equal(commands, first(10))


@pytest.mark.parametrize("redraw", [False, True])
def test_noise_is_drawn_once_or_at_every_plan(redraw):
    planning = Planning(planner={"noise": {"sigma": (0.5,), "redraw": redraw, "null_sample": False}})
    planning()
    first = planning.strategy.noise.z.numpy().copy()
    planning()
    assert np.array_equal(first, planning.strategy.noise.z.numpy()) is not redraw


def test_the_first_samples_are_the_mean_and_the_zero_control():
    planning = Planning()
    planning(3)
    mean = planning.mean[0]  # what the next plan samples around, if no time passes
    planning.elapsed = 0.0
    planning()
    control = planning.engine.recorded.control.numpy()
    np.testing.assert_allclose(control[:, 0], np.clip(mean, -1.0, 1.0), atol=1e-6)
    assert np.all(control[:, 1] == 0.0)
    assert np.abs(mean).max() > 0.1
    assert len({row.tobytes() for row in control.swapaxes(0, 1)}) == planning.plan.shape.samples
    without = Planning(planner={"noise": {"sigma": (0.5,), "null_sample": False}})
    without()
    assert np.any(without.engine.recorded.control.numpy()[:, 1] != 0.0)


@pytest.mark.parametrize("step_size", [1.0, 0.3])
def test_the_mean_moves_by_its_step_size(step_size):
    planning = Planning(planner={**METHODS["predictive_sampling"], "step_size": step_size})
    planning()
    best = planning.cost[0].argmin()
    assert best > 0
    # the mean follows the sample as it was drawn, within the limits
    drawn = planning.scene.planner.noise.sigma[0] * planning.noise[0, best]
    np.testing.assert_allclose(planning.knots[0, best], np.clip(drawn, -1.0, 1.0), atol=1e-6)
    sample = np.clip(step_size * drawn, -1.0, 1.0) / step_size
    np.testing.assert_allclose(planning.mean[0], step_size * sample, atol=1e-6)
    np.testing.assert_allclose(planning.plan.command.numpy()[0], step_size * sample[0], atol=1e-6)
    planning()
    # the plan moved on by one control, the last one held
    expected = step_size * np.concatenate([sample[1:], sample[-1:]])
    np.testing.assert_allclose(planning.knots[0, 0], expected, atol=1e-6)


@pytest.mark.parametrize("knots", [3, 4])
@pytest.mark.parametrize("spline", ["zero", "linear", "cubic", "bspline"])
def test_fewer_knots_than_controls_span_the_horizon(spline, knots):
    planning = Planning(planner={"knots": knots, "spline": spline, "samples": 64})
    planning()
    at_rest = planning.cost[0, 0]
    sampled, control = planning.knots[0], planning.engine.recorded.control.numpy()
    assert sampled.shape == (64, knots, 3)
    if spline != "bspline":  # the others pass through their first and last knot
        np.testing.assert_allclose(control[0], sampled[:, 0], atol=1e-5)
        np.testing.assert_allclose(control[-1], sampled[:, -1], atol=1e-5)
    if spline == "linear":
        along = np.linspace(0.0, knots - 1.0, 8)
        for s in (2, 9):
            expected = np.stack([np.interp(along, np.arange(knots), sampled[s, :, u]) for u in range(3)], axis=1)
            np.testing.assert_allclose(control[:, s], expected, atol=1e-5)
    commands = planning(12)
    assert planning.cost[0, 0] < 0.93 * at_rest
    assert commands[-1, 0, 0] > 0.5


def test_longer_rollout_steps_move_ahead_by_part_of_a_step():
    planner = {**METHODS["predictive_sampling"], "dt": 0.08, "spline": "linear"}
    planning = Planning(planner=planner)
    planning()
    sample = planning.knots[0, planning.cost[0].argmin()]
    planning()
    expected = np.concatenate([0.5 * (sample[:-1] + sample[1:]), sample[-1:]])
    np.testing.assert_allclose(planning.knots[0, 0], expected, atol=1e-6)


@pytest.mark.parametrize("keys", [{"dt": (0.08,)}, {"knots": 4}], ids=["longer steps", "fewer knots"])
def test_zero_order_knots_longer_than_a_control_move_with_time(keys):
    """A plan of zero order that was re-sampled every control kept its first knot for good."""
    planner = {**METHODS["predictive_sampling"], "spline": "zero", **keys}
    planning = Planning(planner=planner)
    planning.elapsed = 0.0
    planning()
    best = planning.knots[0, planning.cost[0].argmin()]
    assert np.ptp(best, axis=0).max() > 0.1
    planning.elapsed = planning.scene.timing.control_dt
    planning.plan.state.weight.fill_(0.0)  # all samples are alike from now on, and the first, the mean, wins
    per_knot = planning.plan.plan_spline.times[1] / planning.scene.timing.control_dt
    assert per_knot > 1.5
    for n in range(1, 25):
        command = planning()[0, 0]
        now = min(int(n / per_knot + 1e-3), len(best) - 1)
        np.testing.assert_allclose(command, best[now], atol=1e-6)


@pytest.mark.parametrize("name", [*METHODS, *ANNEALED])
def test_more_iterations_find_more_in_one_plan(name):
    one, four = (Planning(planner={**METHODS, **ANNEALED}[name] | {"iterations": n}) for n in (1, 4))
    one(2)
    four()
    # the plan after one update, a control later, and after three
    assert four.cost[0, 0] < one.cost[0, 0] - 0.05


def test_cem_narrows_sigma_down_to_its_floor():
    planning = Planning(planner={**METHODS["cem"], "step_size": 1.0})
    assert np.all(planning.sigma == 0.5)
    planning()
    assert 0.1 < planning.sigma.mean() < 0.45
    planning(30)
    sigma = planning.sigma
    assert np.all(sigma >= 0.05 - 1e-6)
    assert sigma.min() < 0.08
    planning.plan.reset()
    assert np.all(planning.sigma == 0.5)
    mppi = Planning(planner=METHODS["mppi"])
    mppi(3)
    assert np.all(mppi.sigma == 0.5)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("knots", ["steps", 5])
def test_the_sigma_of_cem_stays_above_its_floor_however_it_varies_along_the_horizon(knots, seed):
    """Shifted by a cubic, a σ that falls steeply overshoots below zero."""
    planner = {**METHODS["cem"], "knots": knots, "spline": "cubic", "elites": 2}
    planning = Planning(planner=planner, seed=seed)
    planning()
    rng = np.random.default_rng(seed)
    sigma = planning.strategy.distribution.sigma
    planning.elapsed = 0.013
    for n in range(50):
        if n % 5 == 0:
            sigma.assign(np.where(rng.random(sigma.shape) < 0.5, 0.05, 3.0).astype(np.float32))
        planning.strategy.shift()
        assert sigma.numpy().min() >= 0.05 - 1e-6
        planning()
        assert planning.sigma.min() >= 0.05 - 1e-6


@pytest.mark.parametrize(("risk", "reduce"), [("mean", np.mean), ("worst", np.max), ("cvar", None)])
def test_every_sample_is_tried_in_every_domain(risk, reduce):
    random = {"box": {"mass": {"uniform": 0.9}, "friction": {"uniform": 0.9}}}
    planning = Planning(
        object=[{**BOX, "position": (0.36, 0.0, 0.1)}],
        goal={"object": "box", "position": (1.5, 0.0)},
        cost=[{"term": "distance", "between": ["box", "goal"]}],
        randomize=random,
        planner={"domains": 4, "risk": risk, "cvar": 0.5, "samples": 12, "discount": 0.9},
    )
    planning.qd[0, 0] = 1.0
    planning()
    control = planning.engine.recorded.control.numpy().reshape(8, 12, 4, 3)
    assert np.all(control == control[:, :, :1])
    stage = planning.engine.evaluator.cost.numpy()[0].astype(np.float64)
    total = (0.9 ** np.arange(8) @ stage).reshape(12, 4)
    assert np.ptp(total, axis=1).max() > 1e-3  # the domains differ
    expected = np.sort(total, axis=1)[:, 2:].mean(axis=1) if reduce is None else reduce(total, axis=1)
    np.testing.assert_allclose(planning.cost[0], expected, rtol=1e-5)


def test_environments_plan_for_themselves():
    both = Planning(envs=2, planner=METHODS["mppi"])
    both.q[1, :2] = [2.0, 1.0]  # on the other side of the goal
    commands = both(8)
    assert commands[-1, 0, 0] > 0.3
    assert commands[-1, 1, 0] < -0.3
    alone = Planning(planner=METHODS["mppi"])
    np.testing.assert_allclose(commands[:, 0], alone(8)[:, 0], atol=1e-5)


def test_the_next_plan_knows_the_control_that_acts():
    planning, fresh = (Planning(cost=[{"term": "control_rate"}]) for _ in range(2))
    fresh()
    planning()
    planning.strategy.mean.fill_(0.4)
    planning()
    acting = planning.plan.command.numpy().copy()
    assert np.abs(acting).max() > 0.1
    planning()
    np.testing.assert_array_equal(planning.plan.state.last_control.numpy(), acting)
    planning.plan.reset()
    planning()  # the control before the first one is rest again
    np.testing.assert_array_equal(planning.cost, fresh.cost)


def test_a_diverged_world_costs_infinity_and_the_next_plan_is_clean():
    planning, clean = Planning(), Planning()
    state = planning.qd.copy()
    planning.qd[0, 0] = np.nan
    mean = planning.mean
    planning()
    assert np.all(np.isinf(planning.cost))
    assert planning.strategy.weights.weight.numpy().sum() == 0.0
    np.testing.assert_array_equal(planning.mean, mean)
    planning.qd = state
    np.testing.assert_array_equal(planning(3), clean(3))


def test_one_bad_sample_carries_no_weight():
    planning = Planning(
        object=[{**BOX, "position": (-1.0, 0.0, 0.1)}],
        randomize={"box": {"mass": {"uniform": 0.5}}},  # every sample has its own model
        planner={"temperature": {"initial": 10.0, "eta": None}},
    )
    planning.engine.simulator.models[5].opt.gravity[0] = 1e30
    planning()
    weight = planning.strategy.weights.weight.numpy()[0]
    assert np.isinf(planning.cost[0, 5])
    assert np.isfinite(np.delete(planning.cost[0], 5)).all()
    assert weight[5] == 0.0
    assert np.all(np.delete(weight, 5) > 0.0)
    assert np.isfinite(planning.plan.command.numpy()).all()


@pytest.mark.parametrize("key", ["noise", "sigma_min"])
def test_values_per_control_must_be_one_or_as_many_as_controls(key):
    planner = {"noise": {"sigma": (0.1, 0.2)}} if key == "noise" else {"sigma_min": (0.1, 0.2)}
    with pytest.raises(SceneError, match=r"needs 1 or 3 values.*base/x, base/y, base/yaw"):
        Planning(planner=planner)


def test_a_position_drive_is_planned_from_where_it_is_observed():
    """The first plan holds the observed posture, and so does the null sample: not the scene's, nor zero."""
    drive = {"mode": "position", "stiffness": 500.0, "damping": 50.0, "lower": (-2.0,), "upper": (2.0,)}
    planning = Planning(robot=[{**DISC, "joint_q": (0.5, 0.0, 0.0), "drive": {**drive, "effort_limit": 50.0}}])
    for place in ([0.3, -0.4, 1.0], [-0.2, 0.1, 3.0]):
        planning.q[0] = place
        held = np.clip(place, -2.0, 2.0)
        planning()
        np.testing.assert_allclose(planning.knots[0, 0], np.tile(held, (8, 1)), atol=1e-6)
        np.testing.assert_allclose(planning.knots[0, 1], np.tile(held, (8, 1)), atol=1e-6)
        acting = planning.plan.command.numpy().copy()
        planning.q[0] = [0.7, 0.2, 0.0]
        planning()
        # a later plan goes on from its own mean; its null sample follows the observation
        np.testing.assert_array_equal(planning.plan.state.last_control.numpy(), acting)
        assert np.abs(planning.knots[0, 0, 0] - planning.q[0]).max() > 0.05
        np.testing.assert_allclose(planning.knots[0, 1], np.tile(planning.q[0], (8, 1)), atol=1e-6)
        planning.plan.reset()


def test_the_noise_is_annealed_over_iterations_and_horizon():
    anneal = (0.5, 0.8)
    noise = {"sigma": (0.3,), "anneal": anneal, "shape": "identity", "null_sample": False}
    planning = Planning(planner={"iterations": 3, "noise": noise, "samples": 400}, robot=[WIDE])
    planning()
    h = np.arange(1, 9)
    for i in range(3):
        planning.strategy.sample_knots(i, 0, 400)
        knots = planning.knots[0]
        spread = (knots[1:] - knots[0]).std(axis=(0, 2))
        expected = 0.3 * np.exp(-i / (anneal[0] * 3) - (8 - h) / (anneal[1] * 8))  # Xue et al. 2024
        np.testing.assert_allclose(spread, expected, rtol=0.12)


def test_the_last_step_counts_more_by_the_terminal_factor():
    plain, more = (Planning(planner={"terminal": factor, "discount": 0.9}) for factor in (1.0, 7.0))
    plain()
    more()
    stage = plain.engine.evaluator.cost.numpy()[0].astype(np.float64)
    np.testing.assert_array_equal(more.engine.evaluator.cost.numpy()[0], stage)
    weight = 0.9 ** np.arange(8)
    np.testing.assert_allclose(plain.cost[0], weight @ stage, rtol=1e-5)
    weight[-1] *= 7.0
    np.testing.assert_allclose(more.cost[0], weight @ stage, rtol=1e-5)


def test_the_threads_of_the_engine_change_no_bit():
    def commands(threads: int) -> tuple[np.ndarray, np.ndarray]:
        planning = Planning(envs=3, engine={"threads": threads}, planner=METHODS["mppi"])
        planning.q[:, 1] = [0.0, 0.3, -0.5]
        out = planning(4)
        planning.engine.close()
        return out, planning.cost.copy()

    alone, together = commands(1), commands(3)
    for a, b in zip(alone, together, strict=True):
        np.testing.assert_array_equal(a, b)


def test_two_planners_over_the_same_terms_do_not_disturb_each_other():
    cost = [{"term": "distance", "between": ["base/centre", "goal"]}, {"term": "control_rate", "weight": 0.3}]
    alone = [Planning(cost=cost, seed=seed)(6) for seed in (1, 2)]
    first, second = (Planning(cost=cost, seed=seed) for seed in (1, 2))
    shape = second.plan.shape
    second.plan = PlanStep(second.scene, compiled(second.scene), first.costs, shape, engine="mujoco", seed=2)
    for n in range(6):
        np.testing.assert_array_equal(first()[0], alone[0][n])
        np.testing.assert_array_equal(second()[0], alone[1][n])
