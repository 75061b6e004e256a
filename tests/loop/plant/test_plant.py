# SPDX-License-Identifier: Apache-2.0
"""The simulated plant: kicks, delay, noise, success and timeouts, contacts, blow-ups."""

import numpy as np
import pytest
from small_scenes import BOX, DISC, WALL, chain_scene, compiled, make_scene

from warpmpc import Plant, SceneError, Task
from warpmpc.scene.model.pairs import Pair

FAR_BOX = {**BOX, "position": (3.0, 3.0, 0.1)}
STILL = np.zeros(3)


def make_plant(*, seed: int = 0, **sections) -> Plant:
    scene = make_scene(**{"object": [FAR_BOX], **sections})
    return Plant(scene, seed=seed, compiled=compiled(scene))


def run(plant: Plant, steps: int, control=STILL) -> np.ndarray:
    """True velocities before the first and after every step, ``[steps + 1, nv]``."""
    out = [plant.state.joint_qd]
    for _ in range(steps):
        plant.apply(control)
        out.append(plant.state.joint_qd)
    return np.array(out)


@pytest.mark.parametrize("step", [0, 6, 7, 15])  # 0.24 and 0.6 s are sums that floating point misses
def test_a_kick_changes_the_objects_velocity_once(step):
    kick = {"time": 0.04 * step, "target": "box", "velocity": (0.5, -0.4, 1.0)}
    plant, calm = make_plant(plant={"kicks": [kick]}), make_plant()
    kicked, still = run(plant, 18), run(calm, 18)
    np.testing.assert_array_equal(kicked[: step + 1], still[: step + 1])
    # it flies: gravity alone acts on it during the step
    np.testing.assert_allclose(kicked[step + 1, 3:6], [0.5, -0.4, 1.0 - 9.81 * 0.04], atol=0.02)
    np.testing.assert_allclose(kicked[step + 1, 6:], 0.0, atol=1e-3)
    np.testing.assert_allclose(kicked[:, :3], still[:, :3], atol=1e-6)
    # a second kick would throw it again
    speed = np.linalg.norm(kicked[step + 2 :, 3:5], axis=1)
    assert np.all(speed <= np.hypot(0.5, 0.4) + 1e-3)


@pytest.mark.parametrize("step", range(30))
def test_no_kick_is_missed_whatever_its_time(step):
    plant = make_plant(
        plant={"kicks": [{"time": round(0.04 * step, 10), "target": "box", "velocity": (1.0, 0.0, 0.0)}]}
    )
    before = plant._engine.initial.copy()
    times = []
    for plant.steps in range(40):
        plant._engine.initial[:] = before
        plant._disturb()
        if not np.array_equal(plant._engine.initial, before):
            times.append(plant.steps)
    assert times == [step]


def test_a_kick_shoves_a_robots_joints():
    kick = {"time": 0.1, "target": "base", "velocity": (0.0, 2.0, -3.0)}
    robot = {**DISC, "drive": {**DISC["drive"], "damping": 1e-6, "effort_limit": 1e-6}}
    plant = make_plant(robot=[robot], plant={"kicks": [kick]})
    qd = run(plant, 5)
    np.testing.assert_allclose(qd[:3, :3], 0.0, atol=1e-5)
    np.testing.assert_allclose(qd[3, :3], [0.0, 2.0, -3.0], atol=1e-3)
    np.testing.assert_allclose(qd[5, :3], [0.0, 2.0, -3.0], atol=1e-3)


@pytest.mark.parametrize(("target", "count"), [("box", 2), ("base", 4)])
def test_a_kick_with_the_wrong_number_of_values_is_refused(target, count):
    with pytest.raises(SceneError, match=r"plant\.kicks\[0\]\.velocity: needs 3 values"):
        make_plant(plant={"kicks": [{"time": 0.0, "target": target, "velocity": (1.0,) * count}]})


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_observations_are_as_old_as_the_delay(delay):
    plant = make_plant(plant={"delay": 0.04 * delay})
    truth = [plant.state]
    for i in range(8):
        plant.apply(np.array([0.1 * i, 0.2, -0.3]))
        truth.append(plant.state)
        old, seen = truth[max(0, len(truth) - 1 - delay)], plant.observe()
        np.testing.assert_array_equal(seen.joint_q, old.joint_q)
        np.testing.assert_array_equal(seen.joint_qd, old.joint_qd)
        assert seen.time == pytest.approx(old.time)
    assert truth[-1].time == pytest.approx(8 * 0.04)
    plant.reset()
    np.testing.assert_array_equal(plant.observe().joint_q, truth[0].joint_q)


def test_noise_has_the_spread_it_is_given(tmp_path):
    scene = chain_scene(tmp_path).model_copy(
        update={"plant": make_scene(plant={"noise": {"position": 0.02, "velocity": 0.3}}).plant}
    )
    plant = Plant(scene, compiled=compiled(scene))
    truth = plant.state
    seen = [plant.observe() for _ in range(3000)]
    q, qd = (np.array([getattr(s, name) for s in seen], dtype=np.float64) for name in ("joint_q", "joint_qd"))
    layout = plant.layout
    turns = [slice(3, 7), slice(7, 11)]  # of the trunk and the neck
    np.testing.assert_array_equal(layout.joint_type[:2], [4, 2])
    plain = np.delete(np.arange(layout.nq), np.r_[turns[0], turns[1]])
    error = (q - truth.joint_q)[:, plain]
    np.testing.assert_allclose(error.std(axis=0), 0.02, rtol=0.1)
    np.testing.assert_allclose(error.mean(axis=0), 0.0, atol=0.002)
    np.testing.assert_allclose((qd - truth.joint_qd).std(axis=0), 0.3, rtol=0.1)
    for turn in turns:
        np.testing.assert_allclose(np.linalg.norm(q[:, turn], axis=1), 1.0, atol=1e-6)
        assert 0.01 < (q - truth.joint_q)[:, turn].std() < 0.03
    np.testing.assert_array_equal(plant.state.joint_q, truth.joint_q)


def test_seeds_decide_noise():
    noisy = {"noise": {"position": 0.1}}
    a, b, c = (make_plant(seed=s, plant=noisy).observe().joint_q for s in (4, 4, 5))
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a, c)


@pytest.mark.parametrize(("hold", "steps"), [(0.0, 0), (0.12, 3), (0.3, 8)])
def test_success_must_be_held(hold, steps):
    plant = make_plant(goal={"frame": "base/centre", "position": (0.0, 0.0)}, success={"distance": 0.1, "hold": hold})
    for _ in range(steps):
        assert not plant.success
        assert plant.reason == "running"
        plant.apply(STILL)
    assert plant.success
    assert plant.done
    assert plant.reason == "goal reached"


def test_leaving_the_goal_starts_the_hold_anew():
    plant = make_plant(goal={"frame": "base/centre", "position": (0.0, 0.0)}, success={"distance": 0.02, "hold": 0.2})
    run(plant, 2)
    run(plant, 3, np.array([1.0, 0.0, 0.0]))
    assert plant.error.position > 0.02
    while plant.error.position > 0.02:
        plant.apply(np.array([-0.6, 0.0, 0.0]))
    run(plant, 4)
    assert not plant.success
    run(plant, 2)
    assert plant.success


def test_an_episode_times_out():
    plant = make_plant(timing={"control_dt": 0.1, "timeout": 0.7})
    run(plant, 6)
    assert not plant.done
    run(plant, 1)
    assert plant.done
    assert plant.reason == "timeout"
    assert plant.time == pytest.approx(0.7)
    plant.reset()
    assert plant.time == 0.0
    assert not plant.done


def test_driving_into_a_wall_is_accounted_for():
    """A drive of 40 N presses for a known time against the second of two walls."""
    walls = [{**WALL, "name": "far", "position": (-3.0, 0.0, 0.2)}, {**WALL, "position": (0.8, 0.0, 0.2)}]
    robot = {**DISC, "drive": {**DISC["drive"], "damping": 1000.0, "effort_limit": 40.0, "limit": 0.5}}
    plant = make_plant(robot=[robot], obstacle=walls)
    forward = np.array([0.5, 0.0, 0.0])
    run(plant, 15, forward)  # 0.5 m of way take at least 1 s
    assert (plant.contact.time, plant.contact.max_force) == (0.0, 0.0)
    while plant.contact.time == 0.0:
        plant.apply(forward)
    touched = plant.time
    assert 1.0 < touched < 1.3
    run(plant, 20, forward)
    assert plant.contact.time == pytest.approx(plant.time - touched, abs=0.2)
    assert plant.contact.forces["base-far"] == 0.0
    assert plant.contact.forces["base-wall"] == plant.contact.max_force >= 39.0
    forces = dict(zip(plant.pairs, plant.forces, strict=True))
    np.testing.assert_allclose(forces[Pair("base", "wall")], [-40.0, 0.0, 0.0], atol=1.0)
    np.testing.assert_allclose(forces[Pair("base", "far")], 0.0)
    run(plant, 5, -forward)
    gone = plant.contact.time
    run(plant, 5, -forward)
    assert plant.contact.time == gone
    plant.reset()
    assert (plant.contact.time, plant.contact.forces) == (0.0, {})


def test_touching_two_walls_at_once_takes_no_more_time():
    walls = [{**WALL, "name": name, "position": (0.31, y, 0.2)} for name, y in (("left", 1.0), ("right", -1.0))]
    plant = make_plant(obstacle=walls)
    run(plant, 30, np.array([0.5, 0.0, 0.0]))
    assert min(plant.contact.forces[name] for name in ("base-left", "base-right")) > 1.0
    assert 0.8 < plant.contact.time <= plant.time + 1e-9


def test_the_plant_starts_again_as_it_started():
    plant = make_plant(plant={"kicks": [{"time": 0.08, "target": "box", "velocity": (1.0, 0.0, 0.5)}]})
    first = run(plant, 6, np.array([0.5, -0.2, 0.3]))
    plant.reset()
    np.testing.assert_array_equal(run(plant, 6, np.array([0.5, -0.2, 0.3])), first)


def test_finer_steps_than_the_planners():
    fine, coarse = (make_plant(plant={"substeps": n})._engine.model.opt.timestep for n in (8, 2))
    assert (fine, coarse) == pytest.approx((0.005, 0.02))


@pytest.mark.parametrize("control", [np.zeros(2), np.zeros((1, 3)), np.array([0.0, np.nan, 0.0])])
def test_a_control_that_makes_no_sense_is_refused(control):
    with pytest.raises(ValueError, match="3 finite numbers"):
        make_plant().apply(control)


@pytest.mark.parametrize("substeps", [1, 8])
def test_a_plant_that_blows_up_says_so(substeps):
    kick = {"time": 0.04, "target": "box", "velocity": (1e12, 0.0, 0.0)}
    plant = make_plant(plant={"substeps": substeps, "kicks": [kick]})
    run(plant, 1)
    assert not plant.diverged
    run(plant, 1)
    assert plant.done
    assert np.isfinite(plant.state.joint_q).all()  # the last good state
    assert plant.reason == "the plant's physics diverged"
    plant.reset()
    assert not plant.diverged


@pytest.mark.parametrize("support", [True, False])
def test_what_an_object_lies_on_is_no_collision_of_its_own(support):
    table = {"name": "table", "shape": "box", "size": (1.0, 1.0, 0.2), "position": (2.5, 0.0, 0.1), "support": support}
    scene = make_scene(object=[{**BOX, "position": (2.5, 0.0, 0.3)}], obstacle=[WALL, table])
    plant = Plant(scene, compiled=compiled(scene))
    for _ in range(5):
        plant.apply(np.zeros(3))
    weight = plant.contact.forces.get("box-table", 0.0)
    assert (weight == 0.0) if support else (weight > 5.0)  # [N] of 9.8
    assert (plant.contact.time == 0.0) == support
    assert "base-table" in plant.contact.forces


@pytest.mark.parametrize(("plants", "envs"), [(1, 2), (2, 1), (3, 2)])
def test_plants_refuse_a_task_of_another_number_of_environments(plants, envs):
    scene = make_scene()
    with pytest.raises(ValueError, match=f"{plants} plants share a task of {envs} environments"):
        Plant(scene, envs=plants, task=Task(scene, envs=envs))


def test_a_plant_tells_what_cost_terms_are_worth_without_their_weights():
    cost = [
        {"term": "distance", "between": ["base/centre", "goal"], "weight": 7.0, "terminal": 3.0},
        {"name": "speed", "term": "joint_velocity"},
    ]
    scene = make_scene(cost=cost)
    plant = Plant(scene, watch=scene.cost_labels, compiled=compiled(scene))
    assert plant.terms == {}
    for _ in range(3):
        plant.apply(np.array([0.5, 0.2, 0.0]))
    assert plant.terms["distance"] == pytest.approx(plant.error.position, rel=1e-4)
    assert plant.terms["speed"] == pytest.approx(float(np.sum(plant.state.joint_qd**2)), rel=1e-3)
    assert set(plant.terms) == set(scene.cost_labels)
    assert not Plant(scene, compiled=compiled(scene)).terms  # nobody asked
