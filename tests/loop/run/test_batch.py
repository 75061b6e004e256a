# SPDX-License-Identifier: Apache-2.0
"""Many environments at once: each is exactly what it would be alone, and finished ones stand still."""

import numpy as np
import pytest
from small_scenes import BOX, WALL, compiled, make_scene

from warpmpc import Controller, Plant, SceneError, State, run_batch, run_episode
from warpmpc.loop.plant.plant import PlantBatch

RANDOM = {"box": {"mass": {"uniform": 0.3}, "friction": {"uniform": 0.3}, "size": {"normal": 0.005}}}
REAL = {
    "randomize": True,
    "delay": 0.08,
    "noise": {"position": 0.02, "velocity": 0.1},
    "kicks": [{"time": 0.2, "target": "box", "velocity": (0.3, -0.4, 1.0)}],
}
NEAR_BOX = {**BOX, "position": (0.45, 0.0, 0.1)}
NEAR_WALL = {**WALL, "position": (1.0, 0.0, 0.2)}


def real_scene(**sections):
    """A disc in front of a box and a wall; its plants are noisy, late, kicked and randomized."""
    pushing = {"object": [NEAR_BOX], "obstacle": [NEAR_WALL], "randomize": RANDOM, "plant": REAL}
    return make_scene(**{**pushing, **sections})


def controls(steps: int, envs: int) -> np.ndarray:
    """Controls ``[steps, E, 3]`` that push the disc against the box."""
    push = np.random.default_rng(0).uniform(-0.3, 0.3, (steps, envs, 3)).astype(np.float32)
    push[..., 0] += 0.7
    return push


def assert_same(plant: Plant, other: Plant) -> None:
    """Two plants show the same, to the last bit."""
    assert plant.state.time == other.state.time
    for name in ("joint_q", "joint_qd"):
        np.testing.assert_array_equal(getattr(plant.state, name), getattr(other.state, name))
    np.testing.assert_array_equal(plant.body_q, other.body_q)
    np.testing.assert_array_equal(plant.forces, other.forces)
    assert plant.contact == other.contact
    assert plant.error.position == other.error.position
    assert (plant.steps, plant.reason) == (other.steps, other.reason)


def test_a_plant_of_a_batch_is_the_plant_alone():
    scene = real_scene()
    batch = Plant(scene, envs=4, seed=7, compiled=compiled(scene))
    alone = [Plant(scene, seed=7 + e, compiled=compiled(scene)) for e in range(4)]
    assert isinstance(batch, PlantBatch)
    assert batch.envs == 4
    np.testing.assert_array_equal(batch.task["goal"], [plant.goal for plant in alone])
    for _ in range(2):
        for control in controls(30, 4):
            seen = batch.observe()
            for e, plant in enumerate(alone):
                single = plant.observe()
                np.testing.assert_array_equal(seen.joint_q[e], single.joint_q)
                np.testing.assert_array_equal(seen.joint_qd[e], single.joint_qd)
                assert seen.time[e] == single.time
                plant.apply(control[e])
            batch.apply(control)
            for one, other in zip(batch.plants, alone, strict=True):
                assert_same(one, other)
        assert len({float(q[3]) for q in batch.state.joint_q}) == 4  # the boxes went four ways
        assert all(plant.contact.time > 0.0 for plant in alone)
        for plant in (batch, *alone):
            plant.reset()


def test_one_environment_is_a_plain_plant():
    scene = make_scene()
    assert type(Plant(scene, envs=1, compiled=compiled(scene))) is Plant
    with pytest.raises(ValueError, match="at least one plant, not 0"):
        Plant(scene, envs=0, compiled=compiled(scene))


def test_finished_plants_stand_still():
    """Two discs drive at different speeds, a third one away from the goal."""
    scene = real_scene(
        goal={"frame": "base/centre", "position": (0.4, 0.0)}, object=[{**BOX, "position": (3.0, 3.0, 0.1)}]
    )
    batch = Plant(scene, envs=3, compiled=compiled(scene))
    alone = [Plant(scene, seed=e, compiled=compiled(scene)) for e in range(3)]
    control = np.array([[1.0, 0.0, 0.0], [0.4, 0.0, 0.0], [-0.1, 0.0, 0.0]], np.float32)
    finished = {}
    while not batch.done:
        control[~batch.running] = np.nan  # nobody looks at it
        batch.apply(control)
        for e, plant in enumerate(alone):
            if not plant.done:
                plant.apply(control[e])
            assert_same(batch.plants[e], plant)
        finished.update({e: batch.time for e in np.flatnonzero(~batch.running) if e not in finished})
    assert finished[0] < finished[1] < finished[2]
    assert [plant.time for plant in batch.plants] == pytest.approx([finished[e] for e in range(3)])
    assert batch.reasons == ("goal reached", "goal reached", "timeout")
    np.testing.assert_array_equal(batch.success, [True, True, False])
    assert batch.time == batch.observe().time.max() + 0.08 == scene.timing.timeout
    before = batch.state
    batch.apply(control)
    np.testing.assert_array_equal(batch.state.joint_q, before.joint_q)
    assert batch.plants[2].steps == 100


@pytest.mark.parametrize("control", [np.zeros(3), np.zeros((3, 3)), np.full((2, 3), np.nan)])
def test_controls_that_make_no_sense_are_refused(control):
    scene = make_scene()
    batch = Plant(scene, envs=2, compiled=compiled(scene))
    with pytest.raises(ValueError, match=r"\[2, 3\] finite numbers"):
        batch.apply(control)
    assert batch.time == 0.0


def test_an_environment_gets_the_command_of_a_controller_alone():
    cost = [{"term": "distance", "between": ["base/centre", "goal"], "metric": "geodesic"}]
    wall = {**WALL, "position": (0.6, 0.0, 0.2), "size": (0.1, 0.6, 0.4)}
    scene = make_scene(object=[BOX], obstacle=[wall], cost=cost, planner={"samples": 16, "horizon": 4})
    batch = Controller(scene, seed=3, envs=3, compiled=compiled(scene))
    alone = [Controller(scene, seed=3, compiled=compiled(scene)) for _ in range(3)]
    goals = batch.task["goal"]
    goals[:, 1] += [-0.5, 0.0, 0.3]
    batch.task["goal"] = goals
    for controller, goal in zip(alone, goals, strict=True):
        controller.task["goal"] = goal
    rng = np.random.default_rng(1)
    for step in range(5):
        q = np.tile(batch.layout.joint_q, (3, 1))
        q[:, :2] += rng.uniform(-0.2, 0.2, (3, 2)).astype(np.float32)
        qd = rng.uniform(-0.2, 0.2, (3, batch.layout.nv)).astype(np.float32)
        command = batch.step(State(q, qd, 0.04 * step))
        for e, controller in enumerate(alone):
            np.testing.assert_array_equal(command[e], controller.step(State(q[e], qd[e], 0.04 * step)))
            assert batch.info[e].cost == controller.info.cost
            assert batch.info[e].beta == controller.info.beta
    assert len(np.unique(command, axis=0)) == 3


REACH = {"planner": {"samples": 48, "horizon": 8, "temperature": {"initial": 0.1}}}


def run(scene, seeds, **options):
    """Results by seed."""
    results = list(run_batch(scene, seeds, engine="mujoco", compiled=compiled(scene), **options))
    assert len({result.seed for result in results}) == len(results) == len(seeds)
    return {result.seed: result for result in sorted(results, key=lambda result: result.seed)}


def outcome(result) -> dict:
    """A result without its wall times, its number of environments, and what was foreseen, which no batch looks at."""
    data = result.to_json()
    data["verdict"] = [sentence for sentence in data.get("verdict", ()) if "predictions are wrong" not in sentence]
    return {key: value for key, value in data.items() if key not in ("plan_ms", "stages_ms", "envs", "foresight")}


def test_a_batch_of_episodes_ends_as_they_do_one_by_one():
    """Goals, noise and properties are each episode's own; the last round has one episode for its two environments."""
    draw = {"goal.position": {"low": (0.6, -0.4), "high": (1.0, 0.4)}}
    away = {"object": [{**BOX, "position": (-1.0, 0.0, 0.1)}], "obstacle": [WALL]}
    scene = real_scene(**away, randomize_task={"draw": draw}, **REACH)
    seen = []
    results = run(
        scene,
        range(4, 7),
        envs=2,
        on_step=lambda controller, plants, control: seen.append((plants.time, control.shape)),
    )
    assert list(results) == [4, 5, 6]
    assert all(result.success for result in results.values())
    assert {result.envs for result in results.values()} == {2}
    assert len({result.drawn["goal.position"] for result in results.values()}) == 3
    assert {shape for _, shape in seen} == {(2, 3)}
    # a round takes as long as its longest episode
    rounds = max(results[4].sim_time, results[5].sim_time), results[6].sim_time
    assert len(seen) == pytest.approx(sum(rounds) / 0.04)
    one_by_one = run(scene, range(4, 7), envs=1)
    assert [outcome(result) for result in results.values()] == [outcome(result) for result in one_by_one.values()]
    for result in results.values():
        assert 0.0 < result.plan_ms["p50"] <= result.plan_ms["max"]
        assert sum(result.stages_ms.values()) > 0.0


def test_the_first_episode_of_a_batch_is_the_episode_alone():
    scene = real_scene(timing={"control_dt": 0.04, "timeout": 0.4}, **REACH)
    alone = run_episode(scene, seed=5, engine="mujoco", compiled=compiled(scene))
    assert outcome(run(scene, range(5, 7), envs=8)[5]) == outcome(alone)


def test_episodes_that_are_over_at_the_start_make_no_plan():
    scene = make_scene(success={"distance": 5.0})
    for result in run(scene, range(3), envs=2).values():
        assert (result.steps, result.reason) == (0, "goal reached")
        assert result.to_json()["plan_ms"]["p50"] is None
        assert result.to_json()["stages_ms"]["evaluate"] is None


def test_ctrl_c_tells_how_far_every_episode_came():
    scene = make_scene(timing={"control_dt": 0.04, "timeout": 0.4}, planner={"samples": 16, "horizon": 4})

    def stop(controller, plants, control):
        if plants.time > 0.1:
            raise KeyboardInterrupt

    batch = run_batch(scene, range(4), envs=3, compiled=compiled(scene), on_step=stop)
    results = [next(batch) for _ in range(3)]
    assert [(r.seed, r.reason, r.steps) for r in results] == [(seed, "interrupted", 3) for seed in range(3)]
    with pytest.raises(KeyboardInterrupt):
        next(batch)


def test_scenes_that_draw_more_than_goals_are_refused():
    draw = {
        "goal.position": {"low": (0.6, -0.4), "high": (1.0, 0.4)},
        "obstacle.wall.size": {"low": (1.0,) * 3, "high": (2.0,) * 3},
    }
    with pytest.raises(SceneError, match=r"more than their goals \(obstacle\.wall\.size\).* without --envs"):
        run_batch(make_scene(obstacle=[WALL], randomize_task={"draw": draw}), range(4), envs=2)


@pytest.mark.parametrize(("seeds", "envs"), [(range(0), 2), (range(2), 0)])
def test_a_batch_of_nothing_is_refused(seeds, envs):
    with pytest.raises(ValueError, match="at least one environment and one episode"):
        run_batch(make_scene(), seeds, envs=envs)
