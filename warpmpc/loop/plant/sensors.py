# SPDX-License-Identifier: Apache-2.0
"""Sensors of simulated plants: measurements at separate rates, with noise, late, some of them lost.

Sensors inside simulated robots: inertial measurement units, and the encoders and drives of joints.

Depth cameras of simulated plants: rays against the plant's own geometry become points in the world.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from ...scene.errors import SceneError
from ..estimation.free_joints import FreeJoint, exp, multiply
from ..estimation.legs import imu_mount, one_axis_joints
from ..estimation.measurement import ImuMeasured, JointsMeasured, Measurement, PoseMeasured

if TYPE_CHECKING:
    from ...scene.model.compiled_scene import CompiledScene
    from ...scene.model.mujoco_model import MujocoWorld
    from ...scene.schema import Camera, PoseError, PoseSensor, Scene
    from ...scene.schema_estimate import ImuSensor, JointSensor


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
        self._gravity = np.array(compiled.layout.gravity)
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


SLACK = 1e-6
"""Tolerance of lapses of time [s]: times are sums of steps."""


def require_sensors(scene: Scene) -> None:
    """Require that the simulated plant measures what is estimated.

    Raises:
        SceneError: If it does not: what is estimated would stay at its start, or be what is there.
    """
    sensor = scene.plant.sensor
    needed = [("estimate", name, "pose", sensor.pose) for name in scene.estimate]
    for name in scene.estimate_base:
        needed += [("estimate_base", name, "imu", sensor.imu), ("estimate_base", name, "joints", sensor.joints)]
    for key, name, kind, there in needed:
        if name not in there:
            message = f"the simulated plant does not measure it: add [plant.sensor.{kind}.{name}]"
            raise SceneError(message, key=f"{key}.{name}", file=scene.path)


class Sensor(Protocol):
    """Sensor of one thing."""

    rate: float
    """Measurements a second [1/s]."""
    delay: float
    """Time until one is known [s]."""

    def reset(self) -> None:
        """Begin the noise anew."""

    def measure(self, row: np.ndarray, time: float, control: np.ndarray) -> Measurement | None:
        """Measure in a physics state (time, qpos, qvel, act), None where the measurement is lost.

        Args:
            row: The state ``[nx]``.
            time: Its time [s].
            control: What acted until then: ``ctrl``, perhaps with other inputs after it.
        """


class SimulatedPose:
    """Pose sensor.

    Args:
        name: The object or robot.
        sensor: What the scene says of it.
        compiled: The scene, compiled.
        world: MuJoCo's model of the plant.
        seed: Seed of its noise.
    """

    def __init__(self, name: str, sensor: PoseSensor, compiled: CompiledScene, world: MujocoWorld, seed: list[int]):
        self.name, self.rate, self.delay = name, sensor.rate, sensor.delay
        self._sensor, self._seed = sensor, seed
        self._first = 1 + int(world.joint_q[FreeJoint.of(compiled.layout, name, key=f"plant.sensor.pose.{name}").joint])
        self.reset()

    def reset(self) -> None:
        """Begin the noise anew, and draw the bias."""
        self._rng = np.random.default_rng(self._seed)
        self._bias = self._drawn(self._sensor.bias)

    def measure(self, row: np.ndarray, time: float, control: np.ndarray) -> PoseMeasured | None:
        """Measure the pose in a physics state, None where it is lost."""
        lost, error = self._rng.random() < self._sensor.dropouts, self._drawn(self._sensor.noise) + self._bias
        if lost:
            return None
        pose = row[self._first : self._first + 7]
        rotation = multiply(exp(error[3:]), np.roll(pose[3:], -1))  # MuJoCo's are (w, x, y, z)
        return PoseMeasured(self.name, time, np.r_[pose[:3] + error[:3], rotation])

    def _drawn(self, error: PoseError) -> np.ndarray:
        """Errors of position and rotation ``[6]``."""
        return self._rng.normal(size=6) * np.repeat([error.position, error.rotation], 3)


class SimulatedSensors:
    """All sensors of one plant, and the measurements on their way.

    Args:
        scene: The scene.
        compiled: The scene, compiled.
        world: MuJoCo's model of the plant.
        seed: Seed of the noise.

    Raises:
        SceneError: If what is measured does not exist or is not free.
    """

    def __init__(self, scene: Scene, compiled: CompiledScene, world: MujocoWorld, seed: int):
        sensor = scene.plant.sensor
        # units before joints: those of one time are taken in this order
        kinds = ((SimulatedPose, 3, sensor.pose), (SimulatedImu, 4, sensor.imu), (SimulatedJoints, 5, sensor.joints))
        self._sensors: list[Sensor] = [
            kind(name, known, compiled, world, [seed, stream, i])
            for kind, stream, named in kinds
            for i, (name, known) in enumerate(named.items())
        ]
        self.reset()

    def reset(self) -> None:
        """Forget what was measured, and begin the noise anew."""
        self._count = [0] * len(self._sensors)  # measurements that each has made
        self._under_way: deque[tuple[float, Measurement]] = deque()
        for sensor in self._sensors:
            sensor.reset()

    def step(self, rows: np.ndarray, times: np.ndarray, controls: np.ndarray) -> None:
        """Measure in physics states ``[n, nx]`` at times ``[n]`` [s], each in the one next after it is due.

        Args:
            rows: The states.
            times: Their times.
            controls: What acted until then ``[n, nu]``.
        """
        for i, sensor in enumerate(self._sensors):
            for row, time, control in zip(rows, times.tolist(), controls, strict=True):
                if time + SLACK < self._count[i] / sensor.rate:
                    continue
                self._count[i] = math.floor((time + SLACK) * sensor.rate) + 1
                measured = sensor.measure(row, time, control)
                if measured is not None:
                    self._under_way.append((time + sensor.delay, measured))

    def once(self, row: np.ndarray, time: float, control: np.ndarray) -> list[Measurement]:
        """Measurements of all sensors in a physics state ``[nx]`` at a time [s] under a control, known at once."""
        found = (sensor.measure(row, time, control) for sensor in self._sensors)
        return [measured for measured in found if measured is not None]

    def known(self, time: float) -> list[Measurement]:
        """Measurements that became known until a time [s] and were not told before."""
        known = [entry for entry in self._under_way if entry[0] <= time + SLACK]
        self._under_way = deque(entry for entry in self._under_way if entry[0] > time + SLACK)
        return [measured for _, measured in known]


class DepthCamera:
    """One camera in one world of MuJoCo, a ray for every pixel.

    Where a pixel shows the robot it keeps what it showed last, as perception with a filter for the robot does: what
    the arm hides does not vanish.

    Args:
        camera: What the scene says of it.
        model: Model of the world.
        robot: Geoms of the robots.
        seed: Seed of its noise.
    """

    def __init__(self, camera: Camera, model: mujoco.MjModel, robot: Sequence[int], *, seed: int):
        self.camera, self.model, self.data = camera, model, mujoco.MjData(model)
        self._robot = np.zeros(model.ngeom + 1, dtype=bool)  # the last one is no geom at all
        self._robot[list(robot)] = True
        self._ray = pixel_rays(camera)
        self._eye = np.array(camera.position, dtype=float)
        self._geom = np.zeros(len(self._ray), dtype=np.int32)
        self._depth = np.zeros(len(self._ray))
        self._seed = seed
        self.reset()

    def reset(self) -> None:
        """Forget every picture."""
        self._kept = np.full(len(self._ray), np.nan)
        self._rng = np.random.default_rng([self._seed, 2])
        self.pictures = 0

    def due(self, time: float) -> bool:
        """Return whether it is time for the next picture [s]."""
        return time * self.camera.rate >= self.pictures - 1e-6

    def points(self, time: float) -> np.ndarray:
        """Take a picture of :attr:`data` and return all points that are known ``[n, 3]`` [m].

        Args:
            time: When it is taken [s].
        """
        self.pictures = int(time * self.camera.rate + 1e-6) + 1
        mujoco.mj_kinematics(self.model, self.data)
        count, rays = len(self._ray), self._ray.ravel()
        found = (self._geom, self._depth, None, count, self.camera.far)
        mujoco.mj_multiRay(self.model, self.data, self._eye, rays, None, 1, -1, *found)
        seen = ~self._robot[self._geom]
        depth = np.where(self._geom >= 0, self._depth, np.nan)  # nothing there
        if self.camera.noise:
            depth = depth + self._rng.normal(0.0, self.camera.noise, count)
        self._kept[seen] = depth[seen]
        known = np.isfinite(self._kept)
        return (self._eye + self._kept[known, None] * self._ray[known]).astype(np.float32)


def pixel_rays(camera: Camera) -> np.ndarray:
    """Unit vectors from the camera through its pixels, row by row from the upper left ``[n, 3]``."""
    ahead = np.subtract(camera.look_at, camera.position)
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, ahead)
    half = np.tan(np.radians(0.5 * camera.fov))
    y = half * (1.0 - 2.0 * (np.arange(camera.height) + 0.5) / camera.height)
    x = half * camera.width / camera.height * (2.0 * (np.arange(camera.width) + 0.5) / camera.width - 1.0)
    rays = ahead + x[None, :, None] * right + y[:, None, None] * up
    rays = rays.reshape(-1, 3)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)
