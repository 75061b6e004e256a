# SPDX-License-Identifier: Apache-2.0
"""A quadruped's base by its IMU, encoders and efforts, in MuJoCo against the truth; what simulated sensors show."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from estimated_dog import FEET, dog, trot
from scipy.spatial.transform import Rotation

from warpmpc import Plant, SceneError, State, load_scene
from warpmpc.loop.estimation.base_estimator import BaseEstimator
from warpmpc.loop.estimation.measurement import ImuMeasured
from warpmpc.loop.plant.sensors import SimulatedImu, SimulatedJoints
from warpmpc.loop.run.episode import Present
from warpmpc.scene.model.compiled import compile_scene
from warpmpc.scene.schema import EstimateBase, ImuNoise, ImuSensor, JointNoise, JointSensor

SILENT = ImuNoise(gyro=1e-9, accel=1e-9, gyro_walk=0.0, accel_walk=0.0, gyro_bias=0.0, accel_bias=0.0)


def off(seen, true):
    """Errors of rotation, velocity and position ``[9]`` of an observed state."""
    turn = Rotation.from_quat(true.joint_q[3:7]).inv() * Rotation.from_quat(seen.joint_q[3:7])
    return np.r_[turn.as_rotvec(), seen.joint_qd[:3] - true.joint_qd[:3], seen.joint_q[:3] - true.joint_q[:3]]


def normalized_error(plant):
    """Squared error of tilt and velocity by the covariance of the filter, of five numbers."""
    base, true = plant.estimator.parts[0].history.at(plant.time).base, plant.state
    rotation = Rotation.from_quat(true.joint_q[3:7])
    turn = base.rotation @ rotation.as_matrix().T
    # the unit is at the root's origin
    velocity = true.joint_qd[:3] - np.cross(true.joint_qd[3:6], rotation.apply(plant.layout.body_com[0]))
    error = np.r_[Rotation.from_matrix(turn).as_rotvec()[:2], base.velocity - turn @ velocity]
    places = np.ix_([0, 1, 3, 4, 5], [0, 1, 3, 4, 5])
    return error @ np.linalg.solve(base.covariance[places], error)


@pytest.mark.parametrize("seed", range(2))
def test_a_trot_is_followed(seed):
    plant, errors, normalized = Plant(dog(), seed=seed), [], []
    for _ in range(75):
        plant.apply(trot(plant))
        seen = plant.observe()
        errors.append(off(seen, plant.state))
        normalized.append(normalized_error(plant))
    errors = np.array(errors[25:])
    assert 0.1 < np.mean(normalized[25:]) / 5 < 1.5  # contact slips and gives way, and the filter allows for it
    way = plant.state.joint_q[0] + 0.05  # it falls back at first
    assert way > 0.05
    assert np.degrees(np.abs(errors[:, :2]).max()) < 1.0
    assert np.sqrt((errors[:, 3:6] ** 2).mean(axis=0)).max() < 0.03
    assert np.abs(errors[:, 6:]).max() < 0.02
    legs = seen.joint_q[7:] - plant.state.joint_q[7:]
    assert 1e-5 < np.abs(legs).max() < 0.005  # encoders are not the truth
    plant.reset()
    np.testing.assert_array_equal(plant.observe().joint_q[:7], plant.state.joint_q[:7])


def test_late_measurements_change_nothing():
    plant, rng = Plant(dog(), seed=0), np.random.default_rng(0)
    in_order, late = (BaseEstimator("dog", plant.scene.estimate_base["dog"], plant.compiled) for _ in range(2))
    rows = []
    for _ in range(10):
        plant.apply(trot(plant))
        rows += plant.measurements()
    for row in rows:
        assert in_order.update(row)
    for row in sorted(rows, key=lambda row: row.time + rng.uniform(0.0, 0.02)):
        late.update(row)
    for time in (0.1, 0.2):
        ours, theirs = (known.fill(replace(State.start(plant.layout), time=time)) for known in (late, in_order))
        np.testing.assert_array_equal(ours.joint_q, theirs.joint_q)
        np.testing.assert_array_equal(ours.joint_qd, theirs.joint_qd)


@pytest.mark.parametrize("wrong", [{"time": np.nan}, {"gyro": np.full(3, np.nan)}, {"name": "cat"}])
def test_what_is_not_finite_or_of_another_robot_is_left_out(wrong):
    plant = Plant(dog(), seed=0)
    known = BaseEstimator("dog", plant.scene.estimate_base["dog"], plant.compiled)
    measured = ImuMeasured("dog", 0.0, np.zeros(3), np.array([0.0, 0.0, 9.81]))
    assert not known.update(replace(measured, **wrong))
    assert known.history.at(0.0) is None
    assert known.update(measured)


def test_a_late_estimate_is_predicted_to_the_present():
    plant = Plant(dog(delay=0.02), seed=0)

    class Parts:
        compiled, layout, task = plant.compiled, plant.layout, plant.task

    present, errors = Present(plant.scene, Parts()), []
    for _ in range(40):
        control = trot(plant)
        plant.apply(control)
        present.sent(control)
        late = plant.observe()
        seen = present(late, plant.time)
        errors.append([state.joint_q[7:] - plant.state.joint_q[7:] for state in (late, seen)])
        assert late.time == pytest.approx(plant.time - 0.02)
    assert seen.time == pytest.approx(plant.time)
    late, predicted = np.sqrt((np.array(errors)[20:] ** 2).mean(axis=(0, 2)))
    assert predicted < 0.5 * late


def test_a_unit_shows_what_mujocos_own_sensors_do():
    """A dog in the air that moves its legs, and the sensors of MuJoCo at its unit."""
    scene = load_scene("quadruped_walk", overrides=("plant.substeps=16", "robot.dog.position=[0.0, 0.0, 3.0]"))
    plant = Plant(scene, seed=0)
    frame = "dog/trunk_site"
    unit = SimulatedImu("dog", ImuSensor(frame=frame, rate=1000.0, noise=SILENT), plant.compiled, plant.world, [0])
    spec = plant.compiled.spec()
    f = plant.layout.frame(frame)
    body = spec.body(plant.compiled.body_name[plant.layout.frame_body[f]])
    pose = plant.layout.frame_pose[f]
    body.add_site(name="unit", pos=pose[:3], quat=np.roll(pose[3:], 1))
    for kind in ("GYRO", "ACCELEROMETER"):
        sensor = spec.add_sensor(type=getattr(mujoco.mjtSensor, f"mjSENS_{kind}"), name=kind)
        sensor.objtype, sensor.objname = mujoco.mjtObj.mjOBJ_SITE, "unit"
    model = spec.compile()
    model.opt.timestep = plant.model.opt.timestep
    for part in ("ACTUATION", "LIMIT", "CONTACT"):
        model.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{part}"))
    data, rows = mujoco.MjData(model), []
    data.qpos[:] = plant._start[1 : 1 + model.nq]
    data.qvel[3:6] = 1.0, -2.0, 0.5
    for k in range(60):
        data.qfrc_applied[6:] = 4.0 * np.sin(0.1 * k + np.arange(12))
        mujoco.mj_step(model, data)  # what sensors show is of the state before
        rows.append((np.r_[data.time, data.qpos, data.qvel], data.sensordata.copy()))
    shown = [unit.measure(row, float(row[0]), np.zeros(0)) for row, _ in rows]
    assert shown[0] is None
    values = np.array([sensors for _, sensors in rows])
    assert (np.ptp(values, axis=0) > [0.1, 0.1, 0.1, 0.5, 0.5, 0.5]).all()
    # sensors show the state before a step, which ends in the row; MuJoCo turns bodies by the velocity after the step
    for k in range(1, len(rows) - 1):
        np.testing.assert_allclose(shown[k].gyro, values[k + 1, :3], atol=1e-3)
        np.testing.assert_allclose(shown[k].accel, values[k, 3:], atol=0.1)


def test_noise_and_biases_of_a_unit_are_those_of_its_data_sheet():
    noise, seconds, rate = ImuNoise(), 4.0, 400.0
    plant = Plant(dog(), seed=0)
    row, biases = plant._start, []
    for seed in range(30):
        unit = SimulatedImu("dog", ImuSensor(), plant.compiled, plant.world, [seed])
        biases.append((unit.gyro_bias, unit.accel_bias))
    np.testing.assert_allclose(np.std(biases, axis=(0, 2)), [noise.gyro_bias, noise.accel_bias], rtol=0.25)
    shown = [unit.measure(row, k / rate, np.zeros(0)) for k in range(round(seconds * rate))][1:]
    white = np.diff([row.gyro for row in shown], axis=0).std() / np.sqrt(2.0 * rate)
    assert white == pytest.approx(noise.gyro, rel=0.1)
    white = np.diff([row.accel for row in shown], axis=0).std() / np.sqrt(2.0 * rate)
    assert white == pytest.approx(noise.accel, rel=0.1)
    up = np.mean([row.accel for row in shown], axis=0) - unit.accel_bias
    np.testing.assert_allclose(up, [0.0, 0.0, 9.81], atol=0.01)


def test_joints_show_what_drives_do():
    plant = Plant(dog(), seed=0)
    joints = SimulatedJoints(
        "dog", JointSensor(noise=JointNoise(position=0.0, velocity=0.0, effort=0.0)), plant.compiled, plant.world, [0]
    )
    control = trot(plant) + 0.2
    plant.apply(control)
    row, data = plant._engine.state[0, -1], mujoco.MjData(plant.model)
    shown = joints.measure(row, plant.time, plant._engine.control[0, -1])
    np.testing.assert_allclose(shown.q, plant.state.joint_q[7:], atol=1e-6)
    np.testing.assert_allclose(shown.qd, plant.state.joint_qd[6:], atol=1e-5)
    mujoco.mj_setState(plant.model, data, row, int(mujoco.mjtState.mjSTATE_FULLPHYSICS))
    data.ctrl[:] = plant._engine.control[0, -1, : plant.model.nu]
    mujoco.mj_forward(plant.model, data)
    np.testing.assert_allclose(shown.effort, data.qfrc_actuator[6:], atol=1e-9)


@pytest.mark.parametrize(
    ("estimate", "key", "words"),
    [
        ({"frame": "dog/fr_foot"}, "estimate_base.dog.frame", "fixed to the root"),
        ({"frame": "dog/nose"}, "estimate_base.dog.frame", "no such frame"),
        ({"feet": ["dog/hand"]}, "estimate_base.dog.feet", "no such frame"),
        ({"feet": ["goal"]}, "estimate_base.dog.feet", "frame of the robot"),
    ],
)
def test_what_is_wrong_in_a_scene_is_named(estimate, key, words):
    scene = dog()
    known = EstimateBase(**{"feet": FEET, **estimate})
    with pytest.raises(SceneError, match=words) as raised:
        BaseEstimator("dog", known, compile_scene(scene))
    assert raised.value.key == key


def test_a_robot_that_stands_on_the_world_has_no_base_to_estimate():
    with pytest.raises(SceneError, match="free root"):
        BaseEstimator("arm", EstimateBase(feet=["arm/tip"]), compile_scene(load_scene("storm_reach")))
