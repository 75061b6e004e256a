# SPDX-License-Identifier: Apache-2.0
"""Estimates that move as MuJoCo says: contact, gravity, late measurements."""

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_scenes import BOX, compiled, make_scene

from warpmpc import Plant
from warpmpc.estimation.measurement import PoseMeasured
from warpmpc.estimation.physics_filter import DEEP
from warpmpc.estimation.scene_estimator import PoseEstimator
from warpmpc.scene.schema_estimate import Estimate

NOISE = {"position": 0.01, "rotation": 0.03}
PHYSICS = {"model": "physics", "process": {"linear": 0.1, "angular": 0.3}, "noise": NOISE}
VELOCITY = {"process": {"linear": 0.5, "angular": 1.0}, "noise": NOISE}
PUSH = np.array([0.6, 0.0, 0.0], dtype=np.float32)


def make_plant(*, seed=0, sensor=None, estimate=PHYSICS, **box):
    pose = {"box": {"noise": NOISE, **(sensor or {})}}
    plant = {"randomize": False, "sensor": {"pose": pose}}
    scene = make_scene(object=[BOX | box], plant=plant, estimate={"box": estimate})
    return Plant(scene, seed=seed, compiled=compiled(scene))


def error(plant, steps, control=PUSH):
    """Root mean square error of the box's position [m]."""
    rows = []
    for _ in range(steps):
        plant.apply(control)
        rows.append(plant.observe().joint_q[-7:-4] - plant.state.joint_q[-7:-4])
    return np.sqrt(np.mean(np.sum(np.square(rows), axis=1)))


def depth(plant, state):
    """Depth of the deepest contact of the box in an observed state [m]."""
    data = mujoco.MjData(plant.model)
    plant.show(data)
    q = state.joint_q[-7:]
    address = int(plant.world.joint_q[plant.layout.entity("box").joints[0]])
    data.qpos[address : address + 7] = np.r_[q[:3], q[6], q[3:6]]
    mujoco.mj_kinematics(plant.model, data)
    mujoco.mj_collision(plant.model, data)
    return max([-contact.dist for contact in data.contact], default=0.0)


@pytest.mark.parametrize("seed", range(3))
def test_a_pushed_box_is_known_better_than_by_its_velocity_alone(seed):
    by_physics, by_velocity = (error(make_plant(seed=seed, estimate=e), 60) for e in (PHYSICS, VELOCITY))
    assert by_physics < 0.8 * by_velocity


@pytest.mark.parametrize("seed", range(3))
def test_nothing_lies_in_the_robot_or_the_ground(seed):
    noisy = {"noise": {"position": 0.03, "rotation": 0.1}, "rate": 50.0}
    found = {}
    for name, estimate in (("physics", PHYSICS), ("velocity", VELOCITY)):
        plant = make_plant(seed=seed, sensor=noisy, estimate=estimate | {"noise": noisy["noise"]})
        depths = []
        for _ in range(40):
            plant.apply(PUSH)
            depths.append(depth(plant, plant.observe()))
        found[name] = np.array(depths)
    assert np.percentile(found["velocity"], 90) > 0.01
    assert np.percentile(found["physics"], 90) < 4.0 * DEEP
    assert found["physics"].max() < 0.01


def test_a_fall_is_foreseen_over_the_delay_of_its_measurements():
    sensor, high = {"delay": 0.1, "noise": {}}, {"position": (0.6, 0.0, 6.0)}
    by_physics, by_velocity = (
        error(make_plant(sensor=sensor, estimate=e, **high), 20) for e in (PHYSICS, VELOCITY | {"gate": None})
    )
    assert by_physics < 0.02
    assert by_physics < 0.3 * by_velocity


@pytest.mark.parametrize("seed", range(2))
def test_late_measurements_are_as_good_as_ones_in_order(seed):
    plant, rng = make_plant(seed=seed), np.random.default_rng(seed)
    in_order, late = (PoseEstimator("box", Estimate(**PHYSICS), plant.scene, plant.compiled) for _ in range(2))
    on_their_way = []
    for _ in range(25):
        plant.apply(PUSH)
        for measurement in plant.measurements():
            in_order.update(measurement)
            on_their_way.append((plant.time + rng.uniform(0.0, 0.2), measurement))
        for estimator in (in_order, late):
            estimator.fill(plant.state)
        for entry in [entry for entry in on_their_way if entry[0] <= plant.time]:
            on_their_way.remove(entry)
            late.update(entry[1])
    for _, measurement in on_their_way:
        late.update(measurement)
    ours, theirs = late.fill(plant.state), in_order.fill(plant.state)
    np.testing.assert_allclose(ours.joint_q, theirs.joint_q, atol=2e-4)
    np.testing.assert_allclose(ours.joint_qd, theirs.joint_qd, atol=5e-3)


def test_bodies_whose_mass_is_off_their_origin_keep_the_velocity_of_their_mass():
    """A turning body whose measured frame is not its centre of mass: what is shown is the velocity of the centre."""
    plant = make_plant(estimate=VELOCITY | {"gate": None})
    layout = plant.layout.replace(body_com=plant.layout.body_com + np.array([0.2, 0.0, 0.0], np.float32))
    estimator = PoseEstimator("box", Estimate(**VELOCITY), plant.scene, plant.compiled)
    estimator._joint = type(estimator._joint).of(layout, "box", key="")
    for k in range(90):
        turn = Rotation.from_rotvec([0.0, 0.0, k / 30])
        estimator.update(PoseMeasured("box", k / 30, np.r_[0.0, 0.0, 1.0, turn.as_quat()]))
        state = estimator.fill(plant.state.__class__(plant.state.joint_q, plant.state.joint_qd, time=k / 30))
    np.testing.assert_allclose(state.joint_qd[-6:-3], turn.apply([0.0, 0.2, 0.0]), atol=0.01)
    np.testing.assert_allclose(state.joint_qd[-3:], [0.0, 0.0, 1.0], atol=0.02)
