# SPDX-License-Identifier: Apache-2.0
"""Estimator of a robot's free root and joints from an inertial measurement unit, encoders and contact."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from ..model.state import State
from .base_filter import BaseFilter, BaseState
from .free_joints import FreeJoint
from .history import History
from .legs import Legs, one_axis_joints
from .measurement import FARTHEST, ImuMeasured, JointsMeasured, plausible
from .rotation import matrix

if TYPE_CHECKING:
    from ..model.compiled_scene import CompiledScene
    from ..scene.schema_base import EstimateBase, ImuNoise
    from .measurement import Measurement

LONGEST = 0.05
"""Longest time that base and joints go on without a measurement [s]; then they stay where they came to."""
JUMP = {"gyro": 0.05, "accel": 0.15}
"""Change from one measurement of a unit to the next, as a share of its range, beyond which a single one is left out."""
JOINT_SPEED, JOINT_JUMP = 60.0, 40.0
"""Speed, and change of the speed between two measurements, of a joint [rad/s or m/s] beyond which one is left out."""
SHORTEST = 0.002
"""Time that is added to that between two measurements where their change counts [s]: stamps are rounded."""
STRONGEST = 3.0
"""Effort that a joint may show, as a multiple of its drive's limit."""


@dataclass(frozen=True)
class RobotEstimate:
    """Base and joints at a time."""

    base: BaseState
    joints: JointsMeasured | None
    """What joints showed last, None before the first."""
    imu: ImuMeasured | None = None
    """What the unit showed last, likewise."""
    doubted: frozenset[type] = frozenset()
    """Kinds of measurements of which the newest was left out, for it jumped."""


class RobotFilter:
    """The filter of base and joints, for a :class:`History`.

    An inertial measurement unit shows means over the time since it did so last, so that its measurements carry the
    estimate forward and time alone does not. One that jumps away from the one before is left out, and that one stands
    in its place; two in a row are a change.

    Args:
        legs: The robot's legs.
        filter: The filter of its base.
        start: Position ``[3]`` and axes ``[3, 3]`` of its root at the start.
    """

    def __init__(self, legs: Legs, filter: BaseFilter, start: tuple[np.ndarray, np.ndarray], imu: ImuNoise):
        self._legs, self._filter = legs, filter
        self._jump = {"gyro": JUMP["gyro"] * imu.gyro_range, "accel": JUMP["accel"] * imu.accel_range}
        position, rotation = start
        self._begin = position + rotation @ legs.position, rotation

    def start(self, measurement: ImuMeasured | JointsMeasured) -> RobotEstimate:
        """The estimate after the first measurement."""
        position, rotation = self._begin
        base = self._filter.start(measurement.time, rotation, position)
        return self.correct(RobotEstimate(base, None), measurement)

    def predict(self, estimate: RobotEstimate, time: float) -> RobotEstimate:
        """The estimate itself: measurements carry it forward."""
        return estimate

    def correct(self, estimate: RobotEstimate, measurement: ImuMeasured | JointsMeasured) -> RobotEstimate:
        """The estimate at the time of a measurement, with it or with the one before in its place."""
        base, kind = estimate.base, type(measurement)
        last = estimate.imu if kind is ImuMeasured else estimate.joints
        jumped = last is not None and kind not in estimate.doubted and self._jumps(last, measurement)
        believed = replace(last, time=measurement.time) if jumped else measurement
        estimate = replace(estimate, doubted=estimate.doubted | {kind} if jumped else estimate.doubted - {kind})
        if kind is ImuMeasured:
            gyro, accel = self._legs.axes @ believed.gyro, self._legs.axes @ believed.accel
            return replace(estimate, base=self._filter.propagate(base, believed.time, gyro, accel), imu=believed)
        base = self._filter.correct(base, self._legs.measure(base, believed))
        return replace(estimate, base=base, joints=believed)

    def _jumps(self, last: ImuMeasured | JointsMeasured, new: ImuMeasured | JointsMeasured) -> bool:
        """Return whether a measurement is farther from the one before than the robot can come."""
        if isinstance(new, ImuMeasured):
            return any(
                np.linalg.norm(getattr(new, name) - getattr(last, name)) > jump for name, jump in self._jump.items()
            )
        dt = max(new.time - last.time, 0.0)
        moved, faster = np.abs(new.q - last.q), np.abs(new.qd - last.qd)
        return bool((moved > JOINT_SPEED * (dt + SHORTEST)).any() or (faster > JOINT_JUMP).any())

    def reach(self, estimate: RobotEstimate, time: float) -> RobotEstimate:
        """The estimate at a time [s] at which nothing was measured: everything goes on as it moves."""
        base, joints = estimate.base, estimate.joints
        dt = min(max(time - base.time, 0.0), LONGEST)
        moved = replace(
            base,
            time=time,
            position=base.position + dt * base.velocity,
            rotation=base.rotation @ matrix(dt * base.spin),
        )
        if joints is not None:
            dt = min(max(time - joints.time, 0.0), LONGEST)
            joints = replace(joints, time=time, q=joints.q + dt * joints.qd)
        return replace(estimate, base=moved, joints=joints)


class BaseEstimator:
    """Estimator of one robot's free root and joints.

    Args:
        name: The robot.
        estimate: What the scene says of it.
        compiled: The scene, compiled.

    Raises:
        SceneError: As :class:`Legs`.
    """

    def __init__(self, name: str, estimate: EstimateBase, compiled: CompiledScene):
        key, layout = f"estimate_base.{name}", compiled.layout
        self.name, self._legs = name, Legs(name, estimate, compiled)
        self._joint = FreeJoint.of(layout, name, key=key)
        joints = one_axis_joints(layout, name, key=key)
        self._q, self._qd = layout.joint_q_start[joints], layout.joint_qd_start[joints]
        imu, reach = estimate.imu, np.maximum(np.abs(layout.dof_lower), np.abs(layout.dof_upper))[self._qd]
        driven = layout.actuator_effort[np.isfinite(layout.actuator_effort)]
        strongest = STRONGEST * float(driven.max(initial=0.0)) or FARTHEST
        self._largest = {
            ImuMeasured: {"gyro": imu.gyro_range, "accel": imu.accel_range},
            JointsMeasured: {"q": np.minimum(2.0 * reach + 1.0, FARTHEST), "qd": FARTHEST, "effort": strongest},
        }
        position, quaternion = self._joint.pose(layout.joint_q[self._joint.q])
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, np.roll(quaternion, 1))
        start = position, rotation.reshape(3, 3)
        filter = RobotFilter(self._legs, BaseFilter(estimate, len(estimate.feet)), start, estimate.imu)
        self.history: History[RobotEstimate, ImuMeasured | JointsMeasured] = History(filter)

    def reset(self) -> None:
        """Forget every measurement."""
        self.history.reset()

    def update(self, measurement: Measurement) -> bool:
        """Take in what this robot's unit or joints show, if it is plausible; return whether it was taken."""
        if not isinstance(measurement, ImuMeasured | JointsMeasured) or measurement.name != self.name:
            return False
        imu = isinstance(measurement, ImuMeasured)
        taken = plausible(measurement, 3 if imu else len(self._q), self._largest[type(measurement)])
        if taken:
            self.history.insert(measurement)
        return taken

    def trusted(self, time: float) -> bool:
        """Return whether feet that carry something agree with the base at a time [s], and its velocity is known."""
        found = self.history.at(time)
        return found is None or found.base.trusted

    def fill(self, state: State) -> State:
        """The state with this robot's root and joints at its time; before the first measurement as it is."""
        found = self.history.at(float(state.time))
        if found is None:
            return state
        base, rotation, arm = found.base, np.zeros(4), self._legs.position
        mujoco.mju_mat2Quat(rotation, base.rotation.ravel())
        quaternion = np.roll(rotation, -1)
        position = base.position - base.rotation @ arm
        linear = base.velocity - base.rotation @ np.cross(base.spin, arm)
        q, qd = (np.array(array, dtype=np.float32) for array in (state.joint_q, state.joint_qd))
        q[self._joint.q] = self._joint.coordinates(position, quaternion)
        qd[self._joint.qd] = self._joint.velocities(quaternion, linear, base.rotation @ base.spin)
        if found.joints is not None:
            q[self._q], qd[self._qd] = found.joints.q, found.joints.qd
        return replace(state, joint_q=q, joint_qd=qd)
