# SPDX-License-Identifier: Apache-2.0
"""Commands as ROS messages, both ways: the driver writes them, the simulated robot reads them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...scene.errors import SceneError
from ...scene.schema import SplineKind
from .connection import message_class
from .messages import Message, RosTime, floats
from .settings import CommandSettings, CommandType, TrajectoryField
from .topics import own_names

if TYPE_CHECKING:
    from ...planner.plan import Plan
    from ...scene.model.layout import Layout

PIECES = 8
"""Lines between two knots of a curved spline, at most."""
JUMP = 1e-3
"""Share of the time between two knots in which a control jumps from one to the next."""
AXES = tuple(f"{part}.{axis}" for part in ("linear", "angular") for axis in "xyz")
"""Components of a twist."""
_FIELD = {
    "position": TrajectoryField.POSITIONS,
    "velocity": TrajectoryField.VELOCITIES,
    "acceleration": TrajectoryField.ACCELERATIONS,
    "effort": TrajectoryField.EFFORT,
}


class CommandCodec:
    """Turns controls into messages and back.

    Args:
        layout: State layout.
        settings: What the robot is sent.
        clock: Turns seconds into stamps and back.
        file: File of the settings, for errors.

    Raises:
        SceneError: If the settings do not fit the scene's controls.
        ValueError: If the package of the messages is missing.
    """

    def __init__(self, layout: Layout, settings: CommandSettings, clock: RosTime, file: Path | None = None):
        self.type, self._layout, self._clock, self._file = settings.type, layout, clock, file
        self._message = message_class(str(settings.type))
        self._heading: int | None = None
        self._angle = 0.0  # the last finite one that a twist was turned by
        match settings.type:
            case CommandType.TRAJECTORY:
                self._point = message_class("trajectory_msgs/JointTrajectoryPoint")
                self._names = list(settings.names or own_names(layout.control_name))
                self._require(len(self._names), "names")
                self._field = str(settings.field or self._drives())
            case CommandType.TWIST | CommandType.STAMPED_TWIST:
                self._axes = self._components(settings.axes)
                if settings.heading is not None:
                    self._heading = self._turning(settings.heading)

    @property
    def takes_plans(self) -> bool:
        """True if messages have the plan's next controls."""
        return self.type is CommandType.TRAJECTORY

    def write(self, control: np.ndarray, observed: float, joint_q: np.ndarray) -> Message:
        """The message of a control.

        Args:
            control: Control ``[nu]``.
            observed: Time of the newest observation [s].
            joint_q: Joint coordinates then ``[nq]``.
        """
        message = self._message()
        match self.type:
            case CommandType.ARRAY:
                message.data = floats(control)
            case CommandType.TRAJECTORY:
                self._fill(message, control[None], np.zeros(1), observed)
            case CommandType.TWIST:
                self._set(message, self._to_base(control, joint_q))
            case CommandType.STAMPED_TWIST:
                self._clock.write(observed, message.header.stamp)
                self._set(message.twist, self._to_base(control, joint_q))
        return message

    def write_plan(self, plan: Plan, now: float, observed: float, control_dt: float) -> Message:
        """The message of a plan's controls from now on, at points between which its receiver goes in lines.

        Args:
            plan: The plan.
            now: The robot's clock [s].
            observed: Time of the newest observation, from which the points' times count [s].
            control_dt: Time of one planned control [s].
        """
        times = _corners(plan, control_dt)
        times = np.append(now, times[times > now])
        message = self._message()
        self._fill(message, np.stack([plan.at(t) for t in times]), times - observed, observed)
        return message

    def read(self, message: Message, joint_q: np.ndarray) -> tuple[np.ndarray, np.ndarray, float | None]:
        """Times ``[n]`` [s], controls ``[n, nu]`` and stamp [s] of a message, None for one without a header.

        Controls that cannot be read are empty, ``[1, 0]``.

        Args:
            message: The message.
            joint_q: Joint coordinates now ``[nq]``.
        """
        match self.type:
            case CommandType.ARRAY:
                return np.zeros(1), np.array(message.data)[None], None
            case CommandType.TWIST:
                return np.zeros(1), self._to_world(self._get(message), joint_q)[None], None
            case CommandType.STAMPED_TWIST:
                stamp = self._clock.seconds(message.header.stamp)
                return np.zeros(1), self._to_world(self._get(message.twist), joint_q)[None], stamp
        stamp = self._clock.seconds(message.header.stamp)
        names, points = list(message.joint_names), message.points
        rows = [np.asarray(getattr(point, self._field)) for point in points]
        if not rows or sorted(names) != sorted(self._names) or any(len(row) != len(names) for row in rows):
            return np.zeros(1), np.zeros((1, 0)), stamp
        order = [names.index(name) for name in self._names]
        lapses = [point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec for point in points]
        return stamp + np.array(lapses), np.stack(rows)[:, order], stamp

    def _fill(self, message: Message, controls: np.ndarray, lapses: np.ndarray, observed: float) -> None:
        """Write controls ``[n, nu]``, at times after the stamp ``[n]`` [s], into a trajectory."""
        self._clock.write(observed, message.header.stamp)
        message.joint_names = self._names
        for lapse, control in zip(lapses, controls, strict=True):
            point = self._point()
            setattr(point, self._field, floats(control))
            start = point.time_from_start
            start.sec, start.nanosec = divmod(max(0, round(float(lapse) * 1e9)), 10**9)
            message.points.append(point)

    def _to_base(self, control: np.ndarray, joint_q: np.ndarray) -> np.ndarray:
        """A control along the base's axes, by the last finite heading: zeros stay zeros whatever is measured."""
        if self._heading is None:
            return control
        if np.isfinite(angle := float(joint_q[self._heading])):
            self._angle = angle
        return _turned(control, -self._angle)

    def _to_world(self, control: np.ndarray, joint_q: np.ndarray) -> np.ndarray:
        """A control along the world's axes."""
        return control if self._heading is None else _turned(control, float(joint_q[self._heading]))

    def _set(self, twist: Message, values: np.ndarray) -> None:
        for (part, axis), value in zip(self._axes, values, strict=True):
            setattr(getattr(twist, part), axis, float(value))

    def _get(self, twist: Message) -> np.ndarray:
        return np.array([getattr(getattr(twist, part), axis) for part, axis in self._axes])

    def _components(self, axes: tuple[str, ...]) -> list[list[str]]:
        for axis in axes:
            if axis not in AXES:
                self._refuse("a twist has no such component", "axes", axis, AXES)
        self._require(len(axes), "axes")
        return [axis.split(".") for axis in axes]

    def _turning(self, joint: str) -> int:
        if self._axes[:2] != [["linear", "x"], ["linear", "y"]]:
            self._refuse('turns "linear.x" and "linear.y": they come first in command.axes', "heading", joint)
        try:
            return self._layout.joint(joint)
        except SceneError as error:
            return self._refuse(error.message, "heading", joint, error.allowed)

    def _drives(self) -> TrajectoryField:
        """Numbers that the controls are: by the drives where all have one mode, positions where all are held."""
        layout = self._layout
        modes = set(layout.actuator_mode)
        if len(modes) == 1:
            return _FIELD[modes.pop()]
        if not modes and (layout.control_safe >= 0).all():
            return TrajectoryField.POSITIONS
        return self._refuse(
            "the drives do not tell: say which numbers the controls are", "field", None, _FIELD.values()
        )

    def _require(self, count: int, key: str) -> None:
        nu = len(self._layout.control_name)
        if count != nu:
            names = ", ".join(self._layout.control_name)
            self._refuse(f"{count} for {nu} controls ({names}): one for each is needed", key, None)

    def _refuse(self, message: str, key: str, found: object, allowed: Any = None) -> Any:
        raise SceneError(message, key=f"command.{key}", file=self._file, found=found, allowed=allowed)


def _corners(plan: Plan, control_dt: float) -> np.ndarray:
    """Times ``[n]`` [s] between which a plan is a line, or all but one."""
    times, last = plan.times, len(plan.times) - 1
    if last == 0 or plan.spline is SplineKind.LINEAR:
        return times
    intervals = np.diff(times)
    if plan.spline is SplineKind.ZERO:
        return np.sort(np.append(times, times[1:] - JUMP * intervals))
    pieces = int(np.clip(np.ceil(intervals.max() / control_dt - 1e-6), 1, PIECES))
    return np.interp(np.arange(pieces * last + 1) / pieces, np.arange(last + 1), times)


def _turned(control: np.ndarray, angle: float) -> np.ndarray:
    """A control whose first two values are turned by an angle [rad]."""
    turned = np.array(control, dtype=float)
    cosine, sine = np.cos(angle), np.sin(angle)
    turned[:2] = cosine * control[0] - sine * control[1], sine * control[0] + cosine * control[1]
    return turned
