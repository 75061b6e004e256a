# SPDX-License-Identifier: Apache-2.0
"""Sensors inside simulated robots: inertial measurement units, and the encoders and drives of joints."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from ..estimation.free_joints import FreeJoint
from ..estimation.legs import imu_mount, one_axis_joints
from ..estimation.measurement import ImuMeasured, JointsMeasured

if TYPE_CHECKING:
    from ..model.compiled_scene import CompiledScene
    from ..model.mujoco_model import MujocoWorld
    from ..scene.schema_base import ImuSensor, JointSensor


class SimulatedImu:
    """Inertial measurement unit, which shows the means of angular velocity and acceleration since it did so last.

    Args:
        name: The robot.
        sensor: What the scene says of it.
        compiled: The scene, compiled.
        world: MuJoCo's model of the plant.
        seed: Seed of its noise.

    Raises:
        SceneError: If the robot has no free root, or the unit's frame is not fixed to it.
    """

    def __init__(self, name: str, sensor: ImuSensor, compiled: CompiledScene, world: MujocoWorld, seed: list[int]):
        self.name, self.rate, self.delay = name, sensor.rate, sensor.delay
        self._sensor, self._seed = sensor, seed
        key = f"plant.sensor.imu.{name}"
        self._arm, self._axes = imu_mount(compiled, world, name, sensor.frame, key=key)
        joint = FreeJoint.of(compiled.layout, name, key=key).joint
        self._q, self._qd = 1 + int(world.joint_q[joint]), 1 + world.model.nq + int(world.joint_qd[joint])
        self._gravity = world.model.opt.gravity.copy()
        self.reset()

    def reset(self) -> None:
        """Begin the noise anew, and draw the biases."""
        self._rng, noise = np.random.default_rng(self._seed), self._sensor.noise
        self.gyro_bias = self._rng.normal(0.0, noise.gyro_bias, 3)
        self.accel_bias = self._rng.normal(0.0, noise.accel_bias, 3)
        self._last: tuple[float, Rotation, np.ndarray] | None = None

    def measure(self, row: np.ndarray, time: float, control: np.ndarray) -> ImuMeasured | None:
        """Measure in a physics state, None where it is lost, the first, or not later than the one before."""
        rotation = Rotation.from_quat(np.roll(row[self._q + 3 : self._q + 7], -1))  # MuJoCo's are (w, x, y, z)
        linear, angular = row[self._qd : self._qd + 3], row[self._qd + 3 : self._qd + 6]
        velocity = linear + rotation.apply(np.cross(angular, self._arm))
        last, self._last = self._last, (time, rotation, velocity)
        if last is None or time <= last[0]:
            return None
        noise, dt, before = self._sensor.noise, time - last[0], last[1]
        turn = (before.inv() * rotation).as_rotvec()
        middle = before * Rotation.from_rotvec(0.5 * turn)
        force = middle.inv().apply((velocity - last[2]) / dt - self._gravity)
        white, walk = self._rng.normal(size=(2, 3)) / np.sqrt(dt), self._rng.normal(size=(2, 3)) * np.sqrt(dt)
        lost = self._rng.random() < self._sensor.dropouts
        self.gyro_bias, self.accel_bias = (
            self.gyro_bias + noise.gyro_walk * walk[0],
            self.accel_bias + noise.accel_walk * walk[1],
        )
        gyro = turn / dt @ self._axes + self.gyro_bias + noise.gyro * white[0]
        accel = force @ self._axes + self.accel_bias + noise.accel * white[1]
        return None if lost else ImuMeasured(self.name, time, gyro, accel)


class SimulatedJoints:
    """Encoders and drives of the joints of a robot with one axis each.

    Args:
        name: The robot.
        sensor: What the scene says of them.
        compiled: The scene, compiled.
        world: MuJoCo's model of the plant.
        seed: Seed of their noise.

    Raises:
        SceneError: If there is no such robot.
    """

    def __init__(self, name: str, sensor: JointSensor, compiled: CompiledScene, world: MujocoWorld, seed: list[int]):
        self.name, self.rate, self.delay = name, sensor.rate, sensor.delay
        self._sensor, self._seed = sensor, seed
        joints = one_axis_joints(compiled.layout, name, key=f"plant.sensor.joints.{name}")
        self._q, self._qd = world.joint_q[joints], world.joint_qd[joints]
        self._model, self._data = world.model, mujoco.MjData(world.model)
        self.reset()

    def reset(self) -> None:
        """Begin the noise anew."""
        self._rng = np.random.default_rng(self._seed)

    def measure(self, row: np.ndarray, time: float, control: np.ndarray) -> JointsMeasured | None:
        """Measure in a physics state, None where it is lost."""
        model, data, noise = self._model, self._data, self._sensor.noise
        mujoco.mj_setState(model, data, row, int(mujoco.mjtState.mjSTATE_FULLPHYSICS))
        data.ctrl[:] = control[: model.nu]
        for stage in _ACTUATION:
            stage(model, data)
        shown = data.qpos[self._q], data.qvel[self._qd], data.qfrc_actuator[self._qd]
        deviations = noise.position, noise.velocity, noise.effort
        q, qd, effort = (
            part + self._rng.normal(0.0, by, len(part)) for part, by in zip(shown, deviations, strict=True)
        )
        lost = self._rng.random() < self._sensor.dropouts
        return None if lost else JointsMeasured(self.name, time, q, qd, effort)


_ACTUATION = (
    mujoco.mj_kinematics,
    mujoco.mj_comPos,
    mujoco.mj_tendon,
    mujoco.mj_transmission,
    mujoco.mj_fwdVelocity,
    mujoco.mj_fwdActuation,
)
"""Stages of a step up to the forces of actuators, without contacts."""
