# SPDX-License-Identifier: Apache-2.0
"""ROS messages from and to numbers; messages are taken by their fields, so that no ROS package is imported here.

Poses and twists of links as ROS has them, and the joint coordinates that a state has instead.

A ROS odometry message has the pose of the link's frame in the world, and the velocity of the link's origin and its
angular velocity along the link's own axes, child_frame_id in nav_msgs/Odometry. A state has the velocity of the centre
of mass and the angular velocity along the axes of the joint's anchor in the world.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ...loop.estimation.free_joints import FreeJoint, inverse, log, multiply, rotate

if TYPE_CHECKING:
    from ...scene.model.layout import Layout


@dataclass(frozen=True)
class Link:
    """The pose of a link in the world and its twist along its own axes, at its origin."""

    pose: np.ndarray
    """Position [m] and quaternion ``[7]`` (x, y, z, qx, qy, qz, qw)."""
    twist: np.ndarray | None = None
    """Velocity of the origin [m/s] and angular velocity [rad/s] ``[6]``; None where only the pose is known."""


class FloatingBody:
    """A body that floats: its free joint in a state.

    Args:
        layout: State layout.
        joint: Index of the joint.
    """

    def __init__(self, layout: Layout, joint: int):
        self._joint = FreeJoint(layout, joint)
        self.q, self.qd = self._joint.q, self._joint.qd

    def numbers(self, link: Link) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates ``[7]`` and velocities ``[6]`` of the joint; without a twist these are zero."""
        turn = link.pose[3:]
        q = self._joint.coordinates(link.pose[:3], turn)
        if link.twist is None:
            return q, np.zeros(6)
        return q, self._joint.velocities(turn, rotate(turn, link.twist[:3]), rotate(turn, link.twist[3:]))

    def link(self, q: np.ndarray, qd: np.ndarray) -> Link:
        """The link of coordinates ``[7]`` and velocities ``[6]`` of the joint."""
        at, turn = self._joint.pose(q)
        linear, angular = self._joint.twist(turn, qd)
        back = inverse(turn)
        return Link(np.r_[at, turn], np.r_[rotate(back, linear), rotate(back, angular)])


class PlanarJoints:
    """A base on wheels: three joints that move it along x, along y, and turn it, at height zero.

    Args:
        layout: State layout.
        joints: Names of the joints, in this order.

    Raises:
        SceneError: If there is no such joint.
    """

    def __init__(self, layout: Layout, joints: tuple[str, str, str]):
        self.q = np.array([layout.joint(name) for name in joints])
        coordinates = layout.dof_coord.tolist()
        self.qd = np.array([coordinates.index(q) for q in self.q])
        self._yaw = float(layout.joint_q[self.q[2]])  # the last finite one

    def numbers(self, link: Link) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates ``[3]`` and velocities ``[3]`` of the joints; without a twist these are zero.

        The heading is the one nearest to that before: it counts turns from the scene's start.
        """
        x, y, z, w = link.pose[3:]
        yaw = float(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))
        if np.isfinite(yaw):
            self._yaw = yaw = yaw + 2.0 * np.pi * round((self._yaw - yaw) / (2.0 * np.pi))
        q = np.array([*link.pose[:2], yaw])
        if link.twist is None:
            return q, np.zeros(3)
        turn = link.pose[3:]
        return q, np.array([*rotate(turn, link.twist[:3])[:2], rotate(turn, link.twist[3:])[2]])

    def link(self, q: np.ndarray, qd: np.ndarray) -> Link:
        """The link of coordinates ``[3]`` and velocities ``[3]`` of the joints."""
        x, y, yaw = np.asarray(q, dtype=float)
        turn = np.array([0.0, 0.0, np.sin(0.5 * yaw), np.cos(0.5 * yaw)])
        v = rotate(inverse(turn), np.array([qd[0], qd[1], 0.0]))
        return Link(np.array([x, y, 0.0, *turn]), np.array([*v, 0.0, 0.0, qd[2]]))


def difference(before: Link, after: Link, dt: float) -> np.ndarray:
    """The mean twist ``[6]`` between two poses, along the axes of the later one.

    Args:
        before: The earlier pose.
        after: The later pose.
        dt: Time between them [s].
    """
    v = rotate(inverse(after.pose[3:]), after.pose[:3] - before.pose[:3])
    return np.r_[v, log(multiply(inverse(before.pose[3:]), after.pose[3:]))] / dt


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
