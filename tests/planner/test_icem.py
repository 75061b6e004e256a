# SPDX-License-Identifier: Apache-2.0
"""What iCEM adds to the cross-entropy method: a population that decays, elites kept, the mean tried last, σ anew."""

import numpy as np
import pytest
from planning import Planning
from small_scenes import compiled, make_scene

from warpmpc import Controller, Plant, SceneError, State
from warpmpc.engine.launched import LaunchedEngine
from warpmpc.planner.strategy import proposal

DISC = {"method": "icem", "samples": 64, "horizon": 8, "noise": {"sigma": (0.5,)}, "elites": 4}


def rounds(planning: Planning):
    """Plan once, round by round: knots [E, S, P, nu] and costs [E, S] of each, before and after the update."""
    plan, strategy = planning.plan, planning.strategy
    planning.costs.refresh()
    plan.state.joint_q.assign(planning.q)
    plan.state.elapsed.fill_(planning.elapsed)
    strategy.shift()
    for i in range(len(strategy.population)):
        mean = strategy.distribution.mean.numpy().copy()
        strategy.advance(i)
        plan.engine.evaluate(proposal(strategy, i))
        strategy.update(i)
        yield mean, planning.knots, planning.cost.copy()


@pytest.mark.parametrize("envs", [1, 2])
def test_the_population_decays_and_the_rest_costs_infinitely_much(envs):
    planning = Planning(envs=envs, planner=DISC)
    assert planning.strategy.population == (64, 52, 41)  # 64, 64/1.25, 64/1.25²
    for _ in range(3):
        for tried, (_, _, cost) in zip(planning.strategy.population, rounds(planning), strict=True):
            assert np.isfinite(cost[:, :tried]).all()
            assert np.isinf(cost[:, tried:]).all()


def test_there_are_always_enough_samples_for_the_elites_and_those_that_are_not_drawn():
    assert Planning(planner={**DISC, "decay": 10.0}).strategy.population == (64, 8, 8)
    assert Planning(planner={**DISC, "decay": 10.0, "keep_best": 20}).strategy.population == (64, 22, 22)


def test_the_mean_is_tried_in_the_last_iteration_alone():
    planning = Planning(planner=DISC)
    planning()
    *before, last = rounds(planning)
    np.testing.assert_array_equal(last[1][:, 0], np.clip(last[0], -1.0, 1.0))
    for mean, knots, _ in before:
        assert np.abs(knots[:, 0] - np.clip(mean, -1.0, 1.0)).max() > 1e-3


def test_elites_are_kept_over_iterations_and_shifted_from_plan_to_plan():
    planning = Planning(envs=2, planner=DISC)
    planning()
    before = None
    for _ in range(2):
        for i, (_, knots, cost) in enumerate(rounds(planning)):
            if before is not None:
                kept = before if i else np.concatenate([before[:, :, 1:], before[:, :, -1:]], axis=2)
                np.testing.assert_array_equal(knots[:, 1:4], kept)
            order = np.argsort(cost, axis=1, kind="stable")[:, :3]
            before = np.take_along_axis(knots, order[:, :, None, None], axis=1)


def test_every_plan_begins_with_its_own_sigma():
    planning = Planning(planner=DISC)
    start = planning.sigma
    for _ in range(3):
        planning()
        assert planning.sigma.max() < 0.5  # narrowed within the plan
    planning.strategy.shift()
    np.testing.assert_array_equal(planning.sigma, start)


def test_to_begin_anew_needs_something_that_is_adapted():
    with pytest.raises(SceneError, match=r"planner\.covariance\.form: restart is of an adapted covariance"):
        Planning(planner={"method": "mppi", "covariance": {"restart": True}})


def box_scene(engine: str, threads: int, **planner):
    """The disc, planned for by an engine."""
    planner = {**DISC, "samples": 70, **planner}
    return make_scene(planner=planner, engine={"name": engine, "threads": threads})


def commands(scene, envs: int = 1) -> np.ndarray:
    """Commands of some plans from one state."""
    controller = Controller(scene, envs=envs, compiled=compiled(scene))
    q, qd = (np.tile(a, (envs, 1)) for a in (controller.layout.joint_q, controller.layout.joint_qd))
    q[-1, 0] += 0.2
    return np.array([controller.step(State(q, qd, 0.04 * i)) for i in range(5)])


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("envs", [1, 3])
def test_commands_are_those_of_a_population_that_is_rolled_out_whole(threads, envs, monkeypatch):
    """What an engine leaves out changes nothing, however its threads share the rest."""
    parts = commands(box_scene("fused", threads), envs=envs)
    split = LaunchedEngine._split
    monkeypatch.setattr(LaunchedEngine, "_split", lambda self, samples: split(self, self.shape.samples))
    np.testing.assert_array_equal(commands(box_scene("fused", 1), envs=envs), parts)
    assert np.abs(np.diff(parts, axis=0)).max() > 0.01


def test_an_engine_rolls_out_no_more_than_is_tried():
    scene = box_scene("fused", 1, samples=256, decay=4.0)
    engine = Controller(scene, compiled=compiled(scene)).plan_step.engine
    groups = [sum(part[1] for part in engine._split(tried)) * engine.lanes for tried in (256, 64, 16)]
    assert groups == [256, 64, max(16, engine.lanes)]


@pytest.mark.parametrize("seed", range(3))
def test_icem_drives_to_the_goal(seed):
    scene = make_scene(planner={**DISC, "samples": 32, "horizon": 6}, engine={"name": "mujoco", "threads": 1})
    controller = Controller(scene, seed=seed, compiled=compiled(scene))
    plant = Plant(scene, seed=seed, compiled=compiled(scene), task=controller.task)
    while not plant.done:
        plant.apply(controller.step(plant.observe()))
    assert plant.reason == "goal reached"
