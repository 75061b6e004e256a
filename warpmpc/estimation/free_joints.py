# SPDX-License-Identifier: Apache-2.0
"""Things with a free joint: the pose and velocity of the body in the world, and the joint's numbers in a state."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..scene.errors import SceneError
from .rotation import inverse, multiply, rotate

if TYPE_CHECKING:
    from ..model.layout import Layout

FREE = 4
"""newton.JointType.FREE"""


class FreeJoint:
    """The free joint of an object or of a robot's root.

    Args:
        layout: State layout.
        name: The object or robot.
        key: Key of the scene that names it.

    Raises:
        SceneError: If there is no such thing, or it is not free.
    """

    def __init__(self, layout: Layout, name: str, *, key: str):
        free = {e.name: e.joints[0] for e in layout.entities if e.joints and layout.joint_type[e.joints[0]] == FREE}
        if name not in free:
            raise SceneError("no object, or robot with a free root, of this name", key=key, found=name, allowed=free)
        self.joint = free[name]
        first, velocity = int(layout.joint_q_start[self.joint]), int(layout.joint_qd_start[self.joint])
        self.q, self.qd = slice(first, first + 7), slice(velocity, velocity + 6)
        """The joint's places in coordinates and velocities."""
        self._parent = layout.joint_pose_parent[self.joint].astype(float)
        self._child = layout.joint_pose_child[self.joint].astype(float)
        self._com = layout.body_com[layout.joint_child[self.joint]].astype(float)

    def coordinates(self, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """Joint coordinates ``[7]`` of the body's position ``[3]`` and quaternion ``[4]`` in the world."""
        back = inverse(self._parent[3:])
        turn = multiply(back, rotation)
        at = rotate(back, position - self._parent[:3]) + rotate(turn, self._child[:3])
        return np.r_[at, multiply(turn, self._child[3:])]

    def pose(self, joint_q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Position ``[3]`` and quaternion ``[4]`` of the body in the world in a state's joint coordinates ``[nq]``."""
        q = joint_q[self.q]
        rotation = multiply(multiply(self._parent[3:], q[3:]), inverse(self._child[3:]))
        at = self._parent[:3] + rotate(self._parent[3:], q[:3]) - rotate(rotation, self._child[:3])
        return at, rotation

    def velocities(self, rotation: np.ndarray, linear: np.ndarray, angular: np.ndarray) -> np.ndarray:
        """Joint velocities ``[6]``, those of the centre of mass.

        Args:
            rotation: Quaternion of the body ``[4]``.
            linear: Velocity of the body's origin in the world ``[3]`` [m/s].
            angular: Its angular velocity in the world ``[3]`` [rad/s].
        """
        back = inverse(self._parent[3:])
        of_com = linear + np.cross(angular, rotate(rotation, self._com))
        return np.r_[rotate(back, of_com), rotate(back, angular)]
