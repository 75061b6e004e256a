# SPDX-License-Identifier: Apache-2.0
"""Things with a free joint: the pose and velocity of the body in the world, and the joint's numbers in a state."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..scene.errors import SceneError
from .rotation import cross, inverse, multiply, rotate

if TYPE_CHECKING:
    from ..model.layout import Layout

FREE = 4
"""newton.JointType.FREE; Newton takes long to import."""


class FreeJoint:
    """The free joint of a body.

    Args:
        layout: State layout.
        joint: Index of the joint.
    """

    def __init__(self, layout: Layout, joint: int):
        self.joint = joint
        first, velocity = int(layout.joint_q_start[joint]), int(layout.joint_qd_start[joint])
        self.q, self.qd = slice(first, first + 7), slice(velocity, velocity + 6)
        """The joint's places in coordinates and velocities."""
        self._parent = np.asarray(layout.joint_pose_parent[joint], dtype=float)
        self._child = np.asarray(layout.joint_pose_child[joint], dtype=float)
        self._com = np.asarray(layout.body_com[layout.joint_child[joint]], dtype=float)

    @classmethod
    def of(cls, layout: Layout, name: str, *, key: str) -> FreeJoint:
        """The free joint of an object or of a robot's root.

        Args:
            layout: State layout.
            name: The object or robot.
            key: Key of the scene that names it.

        Raises:
            SceneError: If there is no such thing, or it is not free.
        """
        roots = {e.name: int(e.joints[0]) for e in layout.entities if e.joints}
        free = {root: joint for root, joint in roots.items() if layout.joint_type[joint] == FREE}
        if name not in free:
            raise SceneError("no object, or robot with a free root, of this name", key=key, found=name, allowed=free)
        return cls(layout, free[name])

    def coordinates(self, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """Joint coordinates ``[7]`` of the body's position ``[3]`` and quaternion ``[4]`` in the world."""
        back = inverse(self._parent[3:])
        turn = multiply(back, rotation)
        at = rotate(back, position - self._parent[:3]) + rotate(turn, self._child[:3])
        return np.r_[at, multiply(turn, self._child[3:])]

    def pose(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Position ``[3]`` and quaternion ``[4]`` of the body in the world of the joint's coordinates ``[7]``."""
        q = np.asarray(q, dtype=float)
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
        of_com = linear + cross(angular, rotate(rotation, self._com))
        return np.r_[rotate(back, of_com), rotate(back, angular)]

    def twist(self, rotation: np.ndarray, qd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Velocity of the body's origin ``[3]`` [m/s] and angular velocity ``[3]`` [rad/s] in the world.

        Args:
            rotation: Quaternion of the body ``[4]``.
            qd: Joint velocities ``[6]``.
        """
        qd = np.asarray(qd, dtype=float)
        angular = rotate(self._parent[3:], qd[3:])
        return rotate(self._parent[3:], qd[:3]) - cross(angular, rotate(rotation, self._com)), angular


def free_joints(layout: Layout) -> dict[str, int]:
    """Free joints of robots and objects by the entity's name; ``entity/body`` where it has several."""
    found: dict[str, int] = {}
    for entity in layout.entities:
        free = [j for j in entity.joints if layout.joint_type[j] == FREE]
        for j in free:
            found[entity.name if len(free) == 1 else layout.body_name[layout.joint_child[j]]] = int(j)
    return found
