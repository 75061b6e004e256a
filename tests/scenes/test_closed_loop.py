# SPDX-License-Identifier: Apache-2.0
"""The shipped scenes in closed loop, randomized plant against randomized rollouts, over several seeds."""

import numpy as np
import pytest

import warpmpc

GRAZE = 5.0  # [N] net force below which a touched obstacle counts as grazed


def episodes(name: str, seeds, overrides=()):
    scene = warpmpc.load_scene(name, overrides=list(overrides))
    return [warpmpc.run_episode(scene, seed=seed) for seed in seeds]


@pytest.mark.parametrize("variant", ["A", "B"])
def test_the_base_pushes_the_box_to_its_goal(variant):
    scene = warpmpc.load_scene(f"omni_push_box:{variant}")
    assert scene.plant.randomize
    assert set(scene.randomize) == {"box"}
    assert scene.timing.control_dt / scene.plant.substeps < (scene.planner.dt or 0.04) / scene.engine.substeps
    for result in episodes(f"omni_push_box:{variant}", (100, 101)):
        assert result.success, result
        assert result.sim_time <= 45.0
        assert result.max_force <= GRAZE or result.time_in_contact < 0.2, result
        assert result.diverged_worlds == 0


def test_the_disc_reaches_drawn_goals_without_collisions():
    results = episodes("point_reach", range(200, 210))
    assert sum(r.success for r in results) >= 9
    assert sum(r.max_force > 0.0 for r in results) <= 1
    assert np.mean([r.sim_time for r in results if r.success]) <= 2.7
    assert len({str(r.drawn) for r in results}) == 10


def test_a_strangers_arm_reaches_a_pose():
    pytest.importorskip("warpmpc")
    for result in episodes("panda_reach_pose", (300, 301)):
        assert result.success, result
        assert result.sim_time <= 10.0


@pytest.mark.parametrize("method", ["predictive_sampling", "cem"])
def test_other_weightings_reach_drawn_goals_too(method):
    results = episodes("point_reach", range(210, 214), [f"planner.method={method}"])
    assert sum(r.success for r in results) >= 3


def test_a_kicked_box_is_brought_to_the_goal_all_the_same():
    kicks = 'plant.kicks=[{time=4.0, target="box", velocity=[0.5,0.5,0.0]}]'
    calm, kicked = (episodes("omni_push_box", (110,), o)[0] for o in ((), (kicks,)))
    assert kicked.success, kicked
    assert kicked.sim_time != calm.sim_time


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["A", "B"])
def test_ten_seeds_all_succeed(variant):
    assert all(r.success for r in episodes(f"omni_push_box:{variant}", range(400, 410)))
