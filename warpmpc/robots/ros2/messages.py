# SPDX-License-Identifier: Apache-2.0
"""ROS messages from and to numbers; messages are taken by their fields, so that no ROS package is imported here."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from typing import Any

import numpy as np

from .links import Link

Message = Any


class RosTime:
    """Turns time stamps into seconds since the second of the first one, which single precision holds for days.

    Args:
        epoch: Time from which seconds count [ns]; the second of the first stamp if None.
    """

    def __init__(self, epoch: int | None = None):
        self._epoch = epoch

    def seconds(self, stamp: Message) -> float:
        """Time of a stamp [s]."""
        if self._epoch is None:
            self._epoch = stamp.sec * 10**9
        return 1e-9 * (stamp.sec * 10**9 + stamp.nanosec - self._epoch)

    def given(self, stamp: Message) -> float:
        """Time of a stamp that is needed [s].

        Raises:
            ValueError: If it is zero, as in messages without a time.
        """
        if stamp.sec == 0 and stamp.nanosec == 0:
            raise ValueError("a message has no time: its sender is to fill in header.stamp")
        return self.seconds(stamp)

    def write(self, seconds: float, stamp: Message) -> None:
        """Write a time [s] into a stamp."""
        stamp.sec, stamp.nanosec = divmod(max(0, round(seconds * 1e9) + (self._epoch or 0)), 10**9)


def read_pose(pose: Message) -> np.ndarray:
    """The pose ``[7]`` of a geometry_msgs/Pose.

    Raises:
        ValueError: If its quaternion is zero.
    """
    p, q = pose.position, pose.orientation
    return _pose(p, q)


def _pose(p: Message, q: Message) -> np.ndarray:
    found = np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w])
    length = np.linalg.norm(found[3:])
    if length < 1e-6:
        raise ValueError("the quaternion of a pose is zero: fill in its orientation")
    found[3:] /= length
    return found


def write_pose(values: np.ndarray, pose: Message) -> None:
    """Write a pose ``[7]`` into a geometry_msgs/Pose."""
    p, q = pose.position, pose.orientation
    p.x, p.y, p.z, q.x, q.y, q.z, q.w = map(float, values)


def write_transform(values: np.ndarray, transform: Message) -> None:
    """Write a pose ``[7]`` into a geometry_msgs/Transform."""
    p, q = transform.translation, transform.rotation
    p.x, p.y, p.z, q.x, q.y, q.z, q.w = map(float, values)


def read_links(kind: str, message: Message, frame: str, world: str) -> list[tuple[Message, Link]]:
    """Stamps and links of a message; none where a tf message does not have the frame.

    Args:
        kind: Type of the message, ``package/Name``.
        message: The message.
        frame: Child frame in a tf message.
        world: Frame of the scene's world.

    Raises:
        ValueError: If a quaternion is zero, or a pose is in another frame; one without a frame is in the world's.
    """
    if kind == "tf2_msgs/TFMessage":
        found = [each for each in message.transforms if each.child_frame_id == frame]
        for each in found:
            _require(each.header.frame_id, world)
        return [(each.header.stamp, Link(_pose(each.transform.translation, each.transform.rotation))) for each in found]
    _require(message.header.frame_id, world)
    if kind == "nav_msgs/Odometry":
        v, w = message.twist.twist.linear, message.twist.twist.angular
        twist = np.array([v.x, v.y, v.z, w.x, w.y, w.z])
        return [(message.header.stamp, Link(read_pose(message.pose.pose), twist))]
    return [(message.header.stamp, Link(read_pose(message.pose)))]


def _require(frame: str, world: str) -> None:
    if frame not in ("", world):
        raise ValueError(f"a pose is in the frame '{frame}', not '{world}': transform it, or set world = \"{frame}\"")


def write_odometry(link: Link, message: Message) -> None:
    """Write a link into a nav_msgs/Odometry, with a twist of zero where it has none."""
    write_pose(link.pose, message.pose.pose)
    twist = np.zeros(6) if link.twist is None else link.twist
    v, w = message.twist.twist.linear, message.twist.twist.angular
    v.x, v.y, v.z, w.x, w.y, w.z = map(float, twist)


class JointOrder:
    """Finds a robot's joints in messages that have any of them, in any order, and others.

    Args:
        names: The robot's names of the joints wanted.
    """

    def __init__(self, names: Sequence[str]):
        self._wanted = {name: i for i, name in enumerate(names)}
        self.names: list[str] = []
        """Names in the newest message."""
        self._there = self._here = np.zeros(0, dtype=int)

    def read(self, message: Message) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray | None]:
        """Places of the joints that a sensor_msgs/JointState has, their positions, velocities and efforts.

        The latter two are None where it has none.

        Raises:
            ValueError: If it has not one position, velocity or effort for each name.
        """
        if message.name != self.names:
            found = [(i, self._wanted[name]) for i, name in enumerate(message.name) if name in self._wanted]
            self._there, self._here = np.array(found, dtype=int).reshape(-1, 2).T
            self.names = list(message.name)
        numbers = [np.asarray(part) for part in (message.position, message.velocity, message.effort)]
        sizes = [len(part) for part in numbers]
        if sizes[0] != len(self.names) or not {*sizes[1:]} <= {0, len(self.names)}:
            found = "{} positions, {} velocities, {} efforts".format(*sizes)
            raise ValueError(f"a message has {len(self.names)} names, {found}: one of each is needed for each name")
        position, *others = numbers
        return self._here, position[self._there], *(part[self._there] if len(part) else None for part in others)


def floats(values: np.ndarray) -> array:
    """An array that messages take as it is, unlike a list, which they check number by number."""
    return array("d", np.asarray(values, dtype=np.float64).tobytes())
