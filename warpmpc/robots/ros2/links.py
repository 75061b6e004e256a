# SPDX-License-Identifier: Apache-2.0
"""Poses and twists of links as ROS has them, and the joint coordinates that a state has instead.

A ROS odometry message has the pose of the link's frame in the world, and the velocity of the link's origin and its
angular velocity along the link's own axes, child_frame_id in nav_msgs/Odometry. A state has the velocity of the centre
of mass and the angular velocity along the axes of the joint's anchor in the world.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from newton import JointType

if TYPE_CHECKING:
    from ...model.layout import Layout

_CONJUGATE = np.array([-1.0, -1.0, -1.0, 1.0])


# numpy's own cross product takes more than all of a message's conversion is given: single vectors are turned by hand


def conjugate(q: np.ndarray) -> np.ndarray:
    """The inverse of a unit quaternion ``[4]`` (x, y, z, w)."""
    return q * _CONJUGATE


def quaternion_product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The product of two quaternions ``[4]`` (x, y, z, w): b turns first."""
    (x, y, z, w), (i, j, k, r) = a.tolist(), b.tolist()
    vector = (w * i + r * x + y * k - z * j, w * j + r * y + z * i - x * k, w * k + r * z + x * j - y * i)
    return np.array([*vector, w * r - x * i - y * j - z * k])


def matrix(q: np.ndarray) -> np.ndarray:
    """The rotation matrix ``[3, 3]`` of a unit quaternion ``[4]`` (x, y, z, w)."""
    x, y, z, w = q.tolist()
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
            [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
            [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The cross product of two vectors ``[3]``."""
    (x, y, z), (i, j, k) = a.tolist(), b.tolist()
    return np.array([y * k - z * j, z * i - x * k, x * j - y * i])


def pose_product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The product of two poses ``[7]`` (x, y, z, qx, qy, qz, qw)."""
    return np.concatenate([a[:3] + matrix(a[3:]) @ b[:3], quaternion_product(a[3:], b[3:])])


def pose_inverse(pose: np.ndarray) -> np.ndarray:
    """The inverse of a pose ``[7]``."""
    return np.concatenate([-pose[:3] @ matrix(pose[3:]), conjugate(pose[3:])])


def yaw_of(q: np.ndarray) -> float:
    """Heading of a quaternion ``[4]`` about the world's vertical [rad]."""
    x, y, z, w = q
    return float(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))


def rotation_vector(q: np.ndarray) -> np.ndarray:
    """The shortest rotation vector ``[3]`` of a unit quaternion ``[4]`` [rad]."""
    q = -q if q[3] < 0.0 else q
    sine = float(np.linalg.norm(q[:3]))
    return q[:3] * (2.0 if sine < 1e-9 else 2.0 * np.arctan2(sine, q[3]) / sine)


@dataclass(frozen=True)
class Link:
    """The pose of a link in the world and its twist along its own axes, at its origin."""

    pose: np.ndarray
    """Position [m] and quaternion ``[7]`` (x, y, z, qx, qy, qz, qw)."""
    twist: np.ndarray | None = None
    """Velocity of the origin [m/s] and angular velocity [rad/s] ``[6]``; None where only the pose is known."""


class FreeJoint:
    """A body that floats: its free joint in a state.

    Args:
        layout: State layout.
        joint: Index of the joint.
    """

    def __init__(self, layout: Layout, joint: int):
        start_q, start_qd = int(layout.joint_q_start[joint]), int(layout.joint_qd_start[joint])
        self.q, self.qd = slice(start_q, start_q + 7), slice(start_qd, start_qd + 6)
        self._parent = np.asarray(layout.joint_pose_parent[joint], dtype=float)
        self._child = np.asarray(layout.joint_pose_child[joint], dtype=float)
        self._com = np.asarray(layout.body_com[layout.joint_child[joint]], dtype=float)
        self._to_parent, self._to_link = pose_inverse(self._parent), pose_inverse(self._child)
        self._turn = matrix(self._to_parent[3:])

    def numbers(self, link: Link) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates ``[7]`` and velocities ``[6]`` of the joint; without a twist these are zero."""
        q = pose_product(pose_product(self._to_parent, link.pose), self._child)
        if link.twist is None:
            return q, np.zeros(6)
        v, w = link.twist[:3], link.twist[3:]
        turn = self._turn @ matrix(link.pose[3:])
        return q, np.concatenate([turn @ (v + cross(w, self._com)), turn @ w])

    def link(self, q: np.ndarray, qd: np.ndarray) -> Link:
        """The link of coordinates ``[7]`` and velocities ``[6]`` of the joint."""
        pose = pose_product(pose_product(self._parent, np.asarray(q, dtype=float)), self._to_link)
        turn = self._turn @ matrix(pose[3:])
        v, w = np.asarray(qd[:3], dtype=float) @ turn, np.asarray(qd[3:], dtype=float) @ turn
        return Link(pose, np.concatenate([v - cross(w, self._com), w]))


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
        yaw = yaw_of(link.pose[3:])
        if np.isfinite(yaw):
            self._yaw = yaw = yaw + 2.0 * np.pi * round((self._yaw - yaw) / (2.0 * np.pi))
        q = np.array([*link.pose[:2], yaw])
        if link.twist is None:
            return q, np.zeros(3)
        turn = matrix(link.pose[3:])
        return q, np.array([*(turn @ link.twist[:3])[:2], (turn @ link.twist[3:])[2]])

    def link(self, q: np.ndarray, qd: np.ndarray) -> Link:
        """The link of coordinates ``[3]`` and velocities ``[3]`` of the joints."""
        x, y, yaw = np.asarray(q, dtype=float)
        turn = np.array([0.0, 0.0, np.sin(0.5 * yaw), np.cos(0.5 * yaw)])
        v = np.array([qd[0], qd[1], 0.0]) @ matrix(turn)
        return Link(np.array([x, y, 0.0, *turn]), np.array([*v, 0.0, 0.0, qd[2]]))


def free_joints(layout: Layout) -> dict[str, int]:
    """Free joints of robots and objects by the entity's name; ``entity/body`` where it has several."""
    found: dict[str, int] = {}
    for entity in layout.entities:
        free = [j for j in entity.joints if layout.joint_type[j] == JointType.FREE]
        for j in free:
            found[entity.name if len(free) == 1 else layout.body_name[layout.joint_child[j]]] = int(j)
    return found


def difference(before: Link, after: Link, dt: float) -> np.ndarray:
    """The mean twist ``[6]`` between two poses, along the axes of the later one.

    Args:
        before: The earlier pose.
        after: The later pose.
        dt: Time between them [s].
    """
    v = (after.pose[:3] - before.pose[:3]) @ matrix(after.pose[3:]) / dt
    turned = quaternion_product(conjugate(before.pose[3:]), after.pose[3:])
    return np.concatenate([v, rotation_vector(turned) / dt])
