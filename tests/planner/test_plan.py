# SPDX-License-Identifier: Apache-2.0
"""The plan step on a real small scene: every method improves its plan, the same way every time."""

import numpy as np
import pytest
from small_scenes import BOX, compiled, make_scene, observed

from warpmpc import SceneError
from warpmpc.cost.stack import CostStack
from warpmpc.engine.mujoco import MujocoEngine
from warpmpc.engine.trajectory import Shape
from warpmpc.model.properties import draw_properties
from warpmpc.planner.plan import PlanStep, step_dt
from warpmpc.task.goal import goal_pose

METHODS = {
    "mppi": {"method": "mppi", "temperature": {"initial": 0.05}},
    "mppi ess": {"method": "mppi", "temperature": {"ess": 5.0}},
    "predictive_sampling": {"method": "predictive_sampling"},
    "cem": {"method": "cem", "elites": 6, "sigma_min": (0.05,)},
}
PLANNER = {"samples": 48, "horizon": 8, "noise": {"sigma": (0.5,)}}
GOAL = np.array([1.0, 0.5])


class Planning:
    """A plan step of the disc that drives to (1, 0.5), away from any controller."""

    def __init__(self, *, seed: int = 0, envs: int = 1, **sections):
        planner = {**PLANNER, **sections.pop("planner", {})}
        scene = make_scene(planner=planner, **sections)
        self.scene, self.layout = scene, compiled(scene).layout
        planner = scene.planner
        shape = Shape(envs, planner.samples, planner.domains, planner.horizon)
        draws = planner.domains if planner.domains > 1 else planner.samples
        self.costs = CostStack(scene, self.layout)
        self.engine = MujocoEngine(
            compiled(scene),
            shape,
            control_dt=step_dt(scene),
            substeps=2,
            pairs=self.costs.pairs,
            properties=draw_properties(scene, self.layout, draws, seed=seed),
        )
        self.plan = PlanStep(scene, self.layout, shape, self.engine, self.costs, seed=seed)
        self.costs.set_goal(np.tile(goal_pose(scene), (envs, 1)))
        self.q, self.qd = (np.tile(a, (envs, 1)) for a in (self.layout.joint_q, self.layout.joint_qd))

    def __call__(self, steps: int = 1) -> np.ndarray:
        """Plan again and again from the same state; returns the commands ``[steps, E, nu]``."""
        out = []
        for _ in range(steps):
            self.plan(observed(self.q, self.qd))
            out.append(self.plan.command.numpy().copy())
        return np.array(out)

    @property
    def cost(self) -> np.ndarray:
        """Costs of all samples ``[E, S]``."""
        return self.plan.weights.cost.numpy()


@pytest.mark.parametrize("name", METHODS)
def test_the_mean_moves_towards_the_optimum(name):
    planning = Planning(planner=METHODS[name])
    planning()
    at_rest = planning.cost[0, 0]
    commands = planning(12)
    # sample 0 is the mean: the plan itself has become cheap
    assert planning.cost[0, 0] < 0.92 * at_rest
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
    np.testing.assert_array_equal(first.plan.mean.numpy(), again.plan.mean.numpy())
    first.plan.reset()
    np.testing.assert_array_equal(commands, first(10))


@pytest.mark.parametrize("redraw", [False, True])
def test_noise_is_drawn_once_or_at_every_plan(redraw):
    planning = Planning(planner={"noise": {"sigma": (0.5,), "redraw": redraw, "null_sample": False}})
    planning()
    first = planning.plan.noise.z.numpy().copy()
    planning()
    assert np.array_equal(first, planning.plan.noise.z.numpy()) is not redraw


def test_the_first_samples_are_the_mean_and_the_zero_control():
    planning = Planning()
    planning(3)
    mean = planning.plan.mean.numpy()[0].copy()  # what the next plan samples around
    planning()
    control = planning.plan.control.numpy()
    np.testing.assert_allclose(control[:, 0], np.clip(mean, -1.0, 1.0), atol=1e-6)
    assert np.all(control[:, 1] == 0.0)
    assert np.abs(mean).max() > 0.1
    assert len({row.tobytes() for row in control.swapaxes(0, 1)}) == planning.plan.shape.samples
    without = Planning(planner={"noise": {"sigma": (0.5,), "null_sample": False}})
    without()
    assert np.any(without.plan.control.numpy()[:, 1] != 0.0)


@pytest.mark.parametrize("step_size", [1.0, 0.3])
def test_the_mean_moves_by_its_step_size(step_size):
    planning = Planning(planner={**METHODS["predictive_sampling"], "step_size": step_size})
    planning()
    best = planning.cost[0].argmin()
    assert best > 0
    sample = planning.plan.knots.numpy()[0, best]
    # the plan moved on by one control, the last one held
    expected = step_size * np.concatenate([sample[1:], sample[-1:]])
    np.testing.assert_allclose(planning.plan.mean.numpy()[0], expected, atol=1e-6)
    np.testing.assert_allclose(planning.plan.command.numpy()[0], step_size * sample[0], atol=1e-6)


@pytest.mark.parametrize("knots", [3, 4])
@pytest.mark.parametrize("spline", ["zero", "linear", "cubic", "bspline"])
def test_fewer_knots_than_controls_span_the_horizon(spline, knots):
    planning = Planning(planner={"knots": knots, "spline": spline, "samples": 64})
    planning()
    at_rest = planning.cost[0, 0]
    sampled, control = planning.plan.knots.numpy()[0], planning.plan.control.numpy()
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
    sample = planning.plan.knots.numpy()[0, planning.cost[0].argmin()]
    expected = np.concatenate([0.5 * (sample[:-1] + sample[1:]), sample[-1:]])
    np.testing.assert_allclose(planning.plan.mean.numpy()[0], expected, atol=1e-6)
    with pytest.raises(SceneError, match=r"planner\.spline"):
        Planning(planner={**planner, "spline": "zero"})


@pytest.mark.parametrize("name", METHODS)
def test_more_iterations_find_more_in_one_plan(name):
    one, four = (Planning(planner={**METHODS[name], "iterations": n}) for n in (1, 4))
    one(2)
    four()
    # the plan after one update, a control later, and after three
    assert four.cost[0, 0] < one.cost[0, 0] - 0.05


def test_cem_narrows_sigma_down_to_its_floor():
    planning = Planning(planner={**METHODS["cem"], "step_size": 1.0})
    assert np.all(planning.plan.sigma.numpy() == 0.5)
    planning()
    assert 0.1 < planning.plan.sigma.numpy().mean() < 0.45
    planning(30)
    sigma = planning.plan.sigma.numpy()
    assert np.all(sigma >= 0.05 - 1e-6)
    assert sigma.min() < 0.08
    planning.plan.reset()
    assert np.all(planning.plan.sigma.numpy() == 0.5)
    mppi = Planning(planner=METHODS["mppi"])
    mppi(3)
    assert np.all(mppi.plan.sigma.numpy() == 0.5)


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
    control = planning.plan.control.numpy().reshape(8, 12, 4, 3)
    assert np.all(control == control[:, :, :1])
    stage = planning.costs.cost.numpy()[0].astype(np.float64)
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
    planning = Planning(cost=[{"term": "control_rate"}])
    planning.plan.mean.fill_(0.4)
    planning()
    np.testing.assert_array_equal(planning.costs.last_control.numpy(), planning.plan.command.numpy())
    assert np.abs(planning.plan.command.numpy()).max() > 0.1
    planning.plan.reset()
    assert np.all(planning.costs.last_control.numpy() == 0.0)


def test_a_diverged_world_costs_infinity_and_the_next_plan_is_clean():
    planning, clean = Planning(), Planning()
    state = planning.qd.copy()
    planning.qd[0, 0] = np.nan
    mean = planning.plan.mean.numpy().copy()
    planning()
    assert np.all(np.isinf(planning.cost))
    assert planning.plan.weights.weight.numpy().sum() == 0.0
    np.testing.assert_array_equal(planning.plan.mean.numpy(), mean)
    planning.qd = state
    np.testing.assert_array_equal(planning(3), clean(3))


def test_one_bad_sample_carries_no_weight():
    planning = Planning(planner={"temperature": {"initial": 10.0, "eta": None}})
    rollout = planning.engine.rollout

    def poisoned(control):
        control.numpy()[2:, 5] = 1e30
        rollout(control)

    planning.engine.rollout = poisoned
    planning()
    weight = planning.plan.weights.weight.numpy()[0]
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
