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

from ...estimation.free_joints import FreeJoint
from ...estimation.rotation import inverse, log, multiply, rotate

if TYPE_CHECKING:
    from ...model.layout import Layout


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
