# SPDX-License-Identifier: Apache-2.0
"""Sensors of simulated plants: measurements at rates of their own, with noise, late, some of them lost."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Protocol

import numpy as np

from ..estimation.free_joints import FreeJoint
from ..estimation.measurement import Measurement, PoseMeasured
from ..estimation.rotation import exp, multiply
from ..scene.errors import SceneError
from .robot_sensors import SimulatedImu, SimulatedJoints

if TYPE_CHECKING:
    from ..model.compiled_scene import CompiledScene
    from ..model.mujoco_model import MujocoWorld
    from ..scene.schema import PoseError, PoseSensor, Scene

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


class Sensors:
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
