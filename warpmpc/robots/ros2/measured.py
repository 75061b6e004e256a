# SPDX-License-Identifier: Apache-2.0
"""Measurements of what a scene estimates, from their topics: poses of things, units and joints of robots."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from ...estimation.measurement import ImuMeasured, JointsMeasured, PoseMeasured
from ..heard import Heard
from .connection import Connection, Inbox
from .messages import JointOrder, Message, RosTime, read_links

if TYPE_CHECKING:
    from collections.abc import Callable

    from ...estimation.measurement import Measurement
    from .settings import Pose
    from .topics import Topics

WAITING = 200
"""Messages of units and joints that wait between two looks, at most: each carries the estimate forward."""


class Measurements:
    """Measurements, stamped with the time at which they were made; they may be late or out of order.

    Args:
        topics: Which topic tells what.
        connection: The node.
        clock: Turns stamps into seconds.

    Raises:
        ValueError: If a topic's name is none, or the package of its messages is missing.
    """

    def __init__(self, topics: Topics, connection: Connection, clock: RosTime):
        self._clock, self._world = clock, topics.settings.world
        self._sources: list[tuple[Inbox, Heard, Callable[[Message], list[Measurement]]]] = []
        for name, pose in topics.measured.items():
            inbox = Inbox(connection, str(pose.type), pose.topic)
            self._add(inbox, f"{pose.type} of {name}", partial(self._of_pose, name, pose))
        for name, base in topics.bases.items():
            unit = Inbox(connection, "sensor_msgs/Imu", base.imu, depth=WAITING)
            self._add(unit, unit.kind, partial(self._of_unit, name))
            joints = Inbox(connection, "sensor_msgs/JointState", topics.settings.joints.topic, depth=WAITING)
            read = partial(self._of_joints, name, JointOrder(base.joints), len(base.joints))
            self._add(joints, f"{joints.kind} of all joints of {name}, with their efforts", read)

    def _add(self, inbox: Inbox, content: str, read: Callable[[Message], list[Measurement]]) -> None:
        self._sources.append((inbox, Heard(inbox.topic, content), read))

    def heard(self) -> list[Heard]:
        """Messages of each topic; of a silent one its problem says why."""
        for inbox, heard, _ in self._sources:
            if not heard.count and not heard.refused:
                heard.problem = inbox.silence()
        return [heard for _, heard, _ in self._sources]

    def take(self) -> list[Measurement]:
        """Measurements that came since the last call; returns at once."""
        found = []
        for inbox, heard, read in self._sources:
            for message, _ in inbox.take():
                try:
                    told = read(message)
                except ValueError as error:
                    heard.refuse(str(error))
                    continue
                for measured in told:
                    heard.note(measured.time)
                found += told
        return found

    def _of_pose(self, name: str, pose: Pose, message: Message) -> list[Measurement]:
        links = read_links(str(pose.type), message, pose.frame or name, self._world)
        return [PoseMeasured(name, self._clock.given(stamp), link.pose) for stamp, link in links]

    def _of_unit(self, name: str, message: Message) -> list[Measurement]:
        if -1.0 in (message.angular_velocity_covariance[0], message.linear_acceleration_covariance[0]):
            raise ValueError("a message says by a covariance of -1 that it lacks angular velocity or acceleration")
        spin, force = message.angular_velocity, message.linear_acceleration
        gyro, accel = np.array([spin.x, spin.y, spin.z]), np.array([force.x, force.y, force.z])
        return [ImuMeasured(name, self._clock.given(message.header.stamp), gyro, accel)]

    def _of_joints(self, name: str, order: JointOrder, count: int, message: Message) -> list[Measurement]:
        """Measurement of the joints; none where the message is about others."""
        here, position, velocity, effort = order.read(message)
        if not len(here):
            return []
        if len(np.unique(here)) < count:
            raise ValueError(f"a message has joints of {name}, but not all, each once: its base is estimated from all")
        if velocity is None or effort is None:
            lacking = "velocities" if velocity is None else "efforts"
            raise ValueError(f"a message has no {lacking}: the base of {name} is estimated from them")
        q, qd, forces = np.zeros((3, count))
        q[here], qd[here], forces[here] = position, velocity, effort
        return [JointsMeasured(name, self._clock.given(message.header.stamp), q, qd, forces)]
