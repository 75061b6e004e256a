# SPDX-License-Identifier: Apache-2.0
"""Source of Newton's joint coordinates and velocities, in which rollouts are recorded, from MuJoCo's."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ...bake.lines import literal
from ...kernels.geometry.kinematics import BALL, FREE
from ...model.layout import IDENTITY
from .model import rotation

if TYPE_CHECKING:
    from ...model.layout import Layout


def coordinates(layout: Layout, j: int, q: int, rows: str) -> list[str]:
    """A joint's coordinates as expressions.

    Args:
        layout: The layout.
        j: The joint.
        q: Its first coordinate in MuJoCo.
        rows: Name of the rotation of the body behind it, row by row.
    """
    kind, (parent, child) = int(layout.joint_type[j]), _anchors(layout, j)
    turn = [f"w.q[{q + i}]" for i in range(4)]  # (w, x, y, z)
    if kind == int(BALL):
        return _ordered(_combine(_left(_conjugate(child[3:])) @ _right(child[3:]), turn))
    if kind != int(FREE):
        return [f"w.q[{q + i}]" for i in range(int(layout.joint_dof_dim[j].sum()))]
    turn = [f"w.q[{q + 3 + i}]" for i in range(4)]
    origin = [f"w.q[{q + i}]" for i in range(3)]
    if (np.stack([parent, child]) == IDENTITY).all():
        return [*origin, *_ordered(turn)]
    back = rotation(_wxyz(parent[3:])).T
    from_child = [[f"{rows}[{3 * i + k}]" for k in range(3)] for i in range(3)]
    at = [f"({o} + {_dot(child[:3], row)} - {literal(float(parent[i]))})"
          for i, (o, row) in enumerate(zip(origin, from_child, strict=True))]  # fmt: skip
    quaternion = _combine(_left(_conjugate(parent[3:])) @ _right(child[3:]), turn)
    return [*_combine(back, at), *_ordered(quaternion)]


def velocities(layout: Layout, j: int, v: int, rows: str, twist: list[str]) -> list[str]:
    """A joint's velocities as expressions.

    Args:
        layout: The layout.
        j: The joint.
        v: Its first velocity in MuJoCo.
        rows: Name of a ball joint's rotation as a matrix, row by row.
        twist: Velocity of the centre of mass and angular velocity of what a free joint moves.
    """
    kind, (parent, child) = int(layout.joint_type[j]), _anchors(layout, j)
    if kind == int(FREE):
        back = rotation(_wxyz(parent[3:])).T
        return twist if (parent == IDENTITY).all() else [*_combine(back, twist[:3]), *_combine(back, twist[3:])]
    speeds = [f"w.v[{v + i}]" for i in range(int(layout.joint_dof_dim[j].sum()))]
    if kind != int(BALL):
        return speeds
    turned = [f"({' + '.join(f'{rows}[{3 * i + k}] * {speed}' for k, speed in enumerate(speeds))})" for i in range(3)]
    return _combine(rotation(_wxyz(child[3:])).T, turned)


def _anchors(layout: Layout, j: int) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(layout.joint_pose_parent[j], float), np.asarray(layout.joint_pose_child[j], float)


def _combine(matrix: np.ndarray, values: list[str]) -> list[str]:
    """A known matrix times values."""
    return [_dot(row, values) for row in matrix]


def _dot(row: np.ndarray, values: list[str]) -> str:
    exact = [round(float(x)) if abs(x - round(float(x))) < 1e-9 else float(x) for x in row]
    terms = [x if a == 1 else f"{literal(float(a))} * {x}" for a, x in zip(exact, values, strict=True) if a]
    return " + ".join(terms) or "(T)0.0f"


def _ordered(q: list[str]) -> list[str]:
    """(x, y, z, w) of (w, x, y, z)."""
    return [*q[1:], q[0]]


def _wxyz(q: np.ndarray) -> np.ndarray:
    """(w, x, y, z) of (x, y, z, w)."""
    return np.array([q[3], *q[:3]])


def _conjugate(q: np.ndarray) -> np.ndarray:
    return np.array([-q[0], -q[1], -q[2], q[3]])


def _left(q: np.ndarray) -> np.ndarray:
    """Matrix of the product with a known quaternion (x, y, z, w) on the left, for (w, x, y, z)."""
    x, y, z, w = q
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])


def _right(q: np.ndarray) -> np.ndarray:
    """The same on the right."""
    x, y, z, w = q
    return np.array([[w, -x, -y, -z], [x, w, z, -y], [y, -z, w, x], [z, y, -x, w]])
