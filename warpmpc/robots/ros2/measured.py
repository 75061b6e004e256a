# SPDX-License-Identifier: Apache-2.0
"""Measurements of what a scene estimates, from their topics: poses of things, units and joints of robots."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ...estimation.measurement import ImuMeasured, JointsMeasured, PoseMeasured
from ..heard import Heard
from .connection import Connection, Inbox
from .messages import JointOrder, Message, RosTime, read_links

if TYPE_CHECKING:
    from collections.abc import Callable

    from .topics import Topics

WAITING = 200
"""Messages of units and joints that wait between two looks, at most: each carries the estimate forward."""


class MeasuredPoses:
    """Measured poses, stamped with the time at which they were measured; they may be late or out of order.

    Args:
        topics: Which topic tells what.
        connection: The node.
        clock: Turns stamps into seconds.

    Raises:
        ValueError: If a topic's name is none, or the package of its messages is missing.
    """

    def __init__(self, topics: Topics, connection: Connection, clock: RosTime):
        self._clock, self._world = clock, topics.settings.world
        self._sources = []
        for name, pose in topics.measured.items():
            inbox = Inbox(connection, str(pose.type), pose.topic)
            self._sources.append((name, pose, inbox, Heard(inbox.topic, f"{pose.type} of {name}")))

    def heard(self) -> list[Heard]:
        """Messages of each topic; of a silent one its problem says why."""
        for _, _, inbox, heard in self._sources:
            if not heard.count and not heard.refused:
                heard.problem = inbox.silence()
        return [heard for *_, heard in self._sources]

    def take(self) -> list[PoseMeasured]:
        """Poses that came since the last call; returns at once."""
        found = []
        for name, pose, inbox, heard in self._sources:
            for message, _ in inbox.take():
                try:
                    links = read_links(str(pose.type), message, pose.frame or name, self._world)
                    told = [PoseMeasured(name, self._clock.given(stamp), link.pose) for stamp, link in links]
                except ValueError as error:
                    heard.refuse(str(error))
                    continue
                for measured in told:
                    heard.note(measured.time)
                found += told
        return found


class MeasuredBases:
    """Measurements of inertial units and joints of robots whose base is estimated.

    Args:
        topics: Which topic tells what.
        connection: The node.
        clock: Turns stamps into seconds.

    Raises:
        ValueError: If a topic's name is none, or the package of its messages is missing.
    """

    def __init__(self, topics: Topics, connection: Connection, clock: RosTime):
        self._clock = clock
        self._units, self._joints = [], []
        for name, base in topics.bases.items():
            unit = Inbox(connection, "sensor_msgs/Imu", base.imu, depth=WAITING)
            self._units.append((name, unit, Heard(unit.topic, unit.kind)))
            joints = Inbox(connection, "sensor_msgs/JointState", topics.settings.joints.topic, depth=WAITING)
            about = Heard(joints.topic, f"{joints.kind} of all joints of {name}, with their efforts")
            self._joints.append((name, joints, about, JointOrder(base.joints), len(base.joints)))

    def heard(self) -> list[Heard]:
        """Messages of each topic; of a silent one its problem says why."""
        for _, inbox, heard, *_ in (*self._units, *self._joints):
            if not heard.count and not heard.refused:
                heard.problem = inbox.silence()
        return [entry[2] for entry in (*self._units, *self._joints)]

    def take(self) -> list[ImuMeasured | JointsMeasured]:
        """Measurements that came since the last call; returns at once."""
        found: list[ImuMeasured | JointsMeasured] = []
        for name, inbox, heard in self._units:
            for message, _ in inbox.take():
                self._take(heard, found, lambda message=message, name=name: self._of_unit(name, message))
        for name, inbox, heard, order, count in self._joints:
            for message, _ in inbox.take():
                self._take(heard, found, lambda m=message, n=name, o=order, c=count: self._of_joints(n, m, o, c))
        return found

    @staticmethod
    def _take(heard: Heard, found: list, read: Callable[[], ImuMeasured | JointsMeasured | None]) -> None:
        """Read a message into what was found, and note it, or why it is refused."""
        try:
            measured = read()
        except ValueError as error:
            heard.refuse(str(error))
            return
        if measured is not None:
            heard.note(measured.time)
            found.append(measured)

    def _of_unit(self, name: str, message: Message) -> ImuMeasured:
        if -1.0 in (message.angular_velocity_covariance[0], message.linear_acceleration_covariance[0]):
            raise ValueError("a message says by a covariance of -1 that it lacks angular velocity or acceleration")
        spin, force = message.angular_velocity, message.linear_acceleration
        gyro, accel = np.array([spin.x, spin.y, spin.z]), np.array([force.x, force.y, force.z])
        return ImuMeasured(name, self._clock.given(message.header.stamp), gyro, accel)

    def _of_joints(self, name: str, message: Message, order: JointOrder, count: int) -> JointsMeasured | None:
        """Measurement of the joints; None where the message is about others."""
        here, position, velocity, effort = order.read(message)
        if not len(here):
            return None
        if len(np.unique(here)) < count:
            raise ValueError(f"a message has joints of {name}, but not all, each once: its base is estimated from all")
        if velocity is None or effort is None:
            lacking = "velocities" if velocity is None else "efforts"
            raise ValueError(f"a message has no {lacking}: the base of {name} is estimated from them")
        q, qd, forces = np.zeros((3, count))
        q[here], qd[here], forces[here] = position, velocity, effort
        return JointsMeasured(name, self._clock.given(message.header.stamp), q, qd, forces)
