# SPDX-License-Identifier: Apache-2.0
"""Things with a free joint: the pose and velocity of the body in the world, and the joint's numbers in a state.

Rotations as quaternions (x, y, z, w) and as rotation vectors, one at a time: SciPy's take 20 times longer.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from ...scene.errors import SceneError

if TYPE_CHECKING:
    from ...scene.model.layout import Layout


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Quaternion ``[4]`` of the rotation b, then a."""
    ax, ay, az, aw = a.tolist()
    bx, by, bz, bw = b.tolist()
    return np.array(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ]
    )


def inverse(q: np.ndarray) -> np.ndarray:
    """Quaternion ``[4]`` of the rotation back."""
    return q * _CONJUGATE


_CONJUGATE = np.array([-1.0, -1.0, -1.0, 1.0])


def rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Vector ``[3]`` turned by a quaternion ``[4]``."""
    x, y, z, w = q.tolist()
    a, b, c = v.tolist()
    tx, ty, tz = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return np.array([a + w * tx + y * tz - z * ty, b + w * ty + z * tx - x * tz, c + w * tz + x * ty - y * tx])


def exp(v: np.ndarray) -> np.ndarray:
    """Quaternion ``[4]`` of a rotation vector ``[3]``."""
    angle = math.sqrt(float(v @ v))
    scale = 0.5 - angle * angle / 48.0 if angle < 1e-4 else math.sin(0.5 * angle) / angle
    return np.array([*(scale * v), math.cos(0.5 * angle)])


def log(q: np.ndarray) -> np.ndarray:
    """Rotation vector ``[3]`` of a quaternion ``[4]``, of at most half a turn."""
    sine = math.sqrt(float(q[:3] @ q[:3]))
    if sine < 1e-8:
        return 2.0 * q[:3] * (1.0 if q[3] >= 0.0 else -1.0)
    return 2.0 * math.atan2(sine, abs(q[3])) / sine * (q[:3] if q[3] >= 0.0 else -q[:3])


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products of vectors ``[..., 3]``."""
    return a[..., _NEXT] * b[..., _LAST] - a[..., _LAST] * b[..., _NEXT]


_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])


def cross_matrix(v: np.ndarray) -> np.ndarray:
    """Matrix ``[3, 3]`` of the cross product with a vector ``[3]``."""
    x, y, z = v.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def matrix(v: np.ndarray) -> np.ndarray:
    """Rotation matrix ``[3, 3]`` of a rotation vector ``[3]`` (Rodrigues)."""
    angle, k = math.sqrt(float(v @ v)), cross_matrix(v)
    if angle < 1e-6:
        return np.eye(3) + k + 0.5 * k @ k
    return np.eye(3) + math.sin(angle) / angle * k + (1.0 - math.cos(angle)) / angle**2 * k @ k


def left_jacobian(v: np.ndarray) -> np.ndarray:
    """J ``[3, 3]`` with exp(v + d) ≈ exp(J d) exp(v) at a rotation vector ``[3]`` (Solà et al. 2018, Eq. 145)."""
    angle, k = math.sqrt(float(v @ v)), cross_matrix(v)
    if angle < 1e-4:
        return np.eye(3) + 0.5 * k + k @ k / 6.0
    return np.eye(3) + (1.0 - math.cos(angle)) / angle**2 * k + (angle - math.sin(angle)) / angle**3 * k @ k


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
