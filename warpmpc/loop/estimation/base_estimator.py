# SPDX-License-Identifier: Apache-2.0
"""Estimator of a robot's free root and joints from an inertial measurement unit, encoders and contact."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from scipy.special import chdtri

from ...scene.model.state import State
from .base_filter import GRAVITY, BaseFilter, BaseState, FeetMeasured, tilted
from .free_joints import FreeJoint, matrix
from .legs import Legs, one_axis_joints
from .measurement import FARTHEST, History, ImuMeasured, JointsMeasured, plausible

if TYPE_CHECKING:
    from ...scene.model.compiled_scene import CompiledScene
    from ...scene.schema_estimate import EstimateBase, ImuNoise
    from .measurement import Measurement

LONGEST = 0.05
"""Longest time that base and joints go on without a measurement [s]; then they stay where they came to."""
SILENT = 0.025
"""Time without a unit after which joints carry the base forward [s]."""
JUMP = {"gyro": 0.03, "accel": 0.15}
"""Change from one measurement of a unit to the next, as a share of its range, beyond which a single one is left out."""
AIR = 0.05
"""Time for which a unit that jumped is left out while no foot stands [s]; then that is a change, or a fault."""
FAR = float(chdtri(3, 1e-4))
"""Squared Mahalanobis distance beyond which the angular velocity jumps."""
SPIN, LASTING = 25.0, 0.05
"""Change of a base's angular velocity that nothing shows [rad/s²], and the time for which what legs tell instead is
wrong in the same way [s]."""
PUSH = 20.0
"""Acceleration of a base that nothing shows [m/s²]."""
JOINT_SPEED, JOINT_JUMP = 60.0, 40.0
"""Speed, and change of the speed between two measurements, of a joint [rad/s or m/s] beyond which one is left out."""
SHORTEST = 0.002
"""Time that is added to that between two measurements where their change counts [s]: stamps are rounded."""
FROZEN, MOVING = 3, 0.02
"""Times that a measurement may be that of before, and the speed from which on that counts [rad/s or m/s]."""
STRONGEST = 3.0
"""Effort that a joint may show, as a multiple of its drive's limit."""


@dataclass(frozen=True)
class RobotEstimate:
    """Base and joints at a time."""

    base: BaseState
    joints: JointsMeasured | None
    """What joints showed last, None before the first."""
    imu: ImuMeasured | None = None
    """What the unit showed last, or what stands in its place; likewise."""
    feet: FeetMeasured | None = None
    """Feet of the last joints, likewise."""
    off: np.ndarray = field(default_factory=lambda: _KNOWN)
    """Covariance of the angular velocity about the base's axes that stands in the unit's place ``[3, 3]`` [rad²/s²]."""
    since: float | None = None
    """Time since when the unit is left out [s]; None where it is believed."""
    jumped: bool = False
    """Whether the newest measurement of joints was left out, for it jumped."""


class RobotFilter:
    """The filter of base and joints, for a :class:`History`.

    An inertial measurement unit shows means over the time since it did so last, so that its measurements carry the
    estimate forward and time alone does not. One that jumps away from the one before is left out until feet that stand
    agree with it. In its place are the angular velocity at which feet are at rest, whose covariance widens the gate,
    and the acceleration at rest; the base is doubted by :data:`SPIN` and :data:`PUSH`, so that feet correct it. So is
    one whose unit is silent. In the air a jump is left out for :data:`AIR`, then the base is doubted by as much as it
    may have moved it.

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
        """The estimate at the time of a measurement, with it or with something else in its place."""
        if isinstance(measurement, ImuMeasured):
            return self._with_unit(estimate, measurement)
        return self._with_joints(estimate, measurement)

    def _with_unit(self, estimate: RobotEstimate, unit: ImuMeasured) -> RobotEstimate:
        """The estimate with what the unit shows, or without where it jumps and feet do not agree with it."""
        base, last, since = estimate.base, estimate.imu, unit.time if estimate.since is None else estimate.since
        if last is None:
            return self._carried(estimate, unit)
        left_out = unit.time - since
        if not self._jumps(estimate, unit):
            if left_out:  # how it turned meanwhile is known as well as both agree now
                turn = tilted(left_out * _distance(unit, last, "gyro"))
                estimate = replace(estimate, base=self._filter.doubted(base, turn, 0.0))
            return self._carried(estimate, unit)
        if estimate.feet is not None and base.contact.any():
            spin = self._legs.axes @ unit.gyro - base.gyro_bias
            agree = self._filter.stands(replace(base, spin=spin), estimate.feet)[base.contact].all()
            if agree and _distance(unit, last, "accel") <= self._jump["accel"]:
                return self._carried(estimate, unit)
        elif left_out > AIR:
            turn, push = (AIR * _distance(unit, last, name) for name in JUMP)
            return self._carried(replace(estimate, base=self._filter.doubted(base, tilted(turn), push)), unit)
        return self._without_unit(replace(estimate, imu=replace(last, time=unit.time)), unit.time)

    def _with_joints(self, estimate: RobotEstimate, joints: JointsMeasured) -> RobotEstimate:
        """The estimate with what joints show, or showed before."""
        last, time = estimate.joints, joints.time
        jumped = last is not None and _joints_jump(last, joints) and not estimate.jumped
        believed = replace(last, time=time) if jumped else joints
        if estimate.imu is not None and time - estimate.imu.time > SILENT:
            estimate = self._without_unit(estimate, time)
        feet = self._legs.measure(estimate.base, believed)
        if estimate.since is not None:
            base, off = self._filter.with_legs(estimate.base, feet, estimate.off)
            imu = replace(estimate.imu, gyro=self._legs.axes.T @ (base.spin + base.gyro_bias))
            estimate = replace(estimate, base=base, imu=imu, off=off)
        base = self._filter.correct(estimate.base, feet)
        return replace(estimate, base=base, joints=believed, feet=feet, jumped=jumped)

    def _carried(self, estimate: RobotEstimate, unit: ImuMeasured) -> RobotEstimate:
        """The estimate carried forward by what a unit shows."""
        gyro, accel = self._legs.axes @ unit.gyro, self._legs.axes @ unit.accel
        base = self._filter.propagate(estimate.base, unit.time, gyro, accel)
        return replace(estimate, base=base, imu=unit, off=_KNOWN, since=None)

    def _without_unit(self, estimate: RobotEstimate, time: float) -> RobotEstimate:
        """The estimate carried forward to a time [s] without a unit, doubted by what a base may do until then."""
        base, filter = estimate.base, self._filter
        dt = max(time - base.time, 0.0)
        known = float(np.sqrt(estimate.off.diagonal().max()))
        off = estimate.off + ((known + SPIN * dt) ** 2 - known**2) * np.eye(3)
        turn = min(dt, LASTING) * LASTING * base.rotation @ off @ base.rotation.T
        rest = base.accel_bias - GRAVITY @ base.rotation
        gyro = self._legs.axes @ estimate.imu.gyro
        base = filter.propagate(filter.doubted(base, turn, dt * PUSH), time, gyro, rest)
        since = time - dt if estimate.since is None else estimate.since
        return replace(estimate, base=base, off=off, since=since)

    def _jumps(self, estimate: RobotEstimate, unit: ImuMeasured) -> bool:
        """Return whether a unit is farther from what is known than the robot can come."""
        if _distance(unit, estimate.imu, "accel") > self._jump["accel"]:
            return True
        turned, jump, axes = unit.gyro - estimate.imu.gyro, self._jump["gyro"], self._legs.axes
        if float(turned @ turned) <= jump**2:
            return False
        spread = axes.T @ estimate.off @ axes + np.eye(3) * jump**2 / FAR
        return float(turned @ np.linalg.solve(spread, turned)) > FAR

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


_KNOWN = np.zeros((3, 3))
"""Covariance of the angular velocity that a unit shows, beside that of a jump."""


def _joints_jump(last: JointsMeasured, new: JointsMeasured) -> bool:
    """Return whether joints are farther from where they were than they can come."""
    dt = max(new.time - last.time, 0.0)
    moved, faster = np.abs(new.q - last.q), np.abs(new.qd - last.qd)
    return bool((moved > JOINT_SPEED * (dt + SHORTEST)).any() or (faster > JOINT_JUMP).any())


def _distance(one: ImuMeasured, other: ImuMeasured, name: str) -> float:
    return float(np.linalg.norm(getattr(one, name) - getattr(other, name)))


class BaseEstimator:
    """Estimator of one robot's free root and joints.

    Args:
        name: The robot.
        estimate: What the scene says of it.
        compiled: The scene, compiled.
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
        base = BaseFilter(estimate, len(estimate.feet), layout.gravity)
        filter = RobotFilter(self._legs, base, start, estimate.imu)
        self.history: History[RobotEstimate, ImuMeasured | JointsMeasured] = History(filter)
        self.reset()

    def reset(self) -> None:
        """Forget every measurement."""
        self.history.reset()
        self._last: dict[type, tuple[ImuMeasured | JointsMeasured, int]] = {}  # and how often it was the same

    def update(self, measurement: Measurement) -> bool:
        """Take in what this robot's unit or joints show, if it is plausible; return whether it was taken."""
        if not isinstance(measurement, ImuMeasured | JointsMeasured) or measurement.name != self.name:
            return False
        imu = isinstance(measurement, ImuMeasured)
        taken = plausible(measurement, 3 if imu else len(self._q), self._largest[type(measurement)])
        taken = None if taken is None or self._frozen(taken) else taken
        if taken is not None:
            self.history.insert(taken)
        return taken is not None

    def _frozen(self, measurement: ImuMeasured | JointsMeasured) -> bool:
        """Return whether a measurement is that of before but for its time, again and again, though the robot moves."""
        kind = type(measurement)
        last, count = self._last.get(kind, (measurement, 0))
        same = all(np.array_equal(getattr(last, name), getattr(measurement, name)) for name in self._largest[kind])
        speeds = measurement.gyro if kind is ImuMeasured else measurement.qd
        self._last[kind] = measurement, count + 1 if same else 0
        return count >= FROZEN and same and float(np.abs(speeds).max(initial=0.0)) > MOVING

    def trusted(self, time: float) -> bool:
        """Return whether feet that carry something agree with the base at a time [s], and its velocity is known."""
        found = self.history.at(time)
        left_out = found is not None and found.since is not None and time - found.since > LONGEST
        return found is None or (found.base.trusted and not left_out)

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
