# SPDX-License-Identifier: Apache-2.0
"""Joints and controls that a cost term is about, by the names in a scene file."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..scene.errors import SceneError
from .keys import Joints, Robots

if TYPE_CHECKING:
    from .binding import Binding
    from .keys import JointLimit


def robot_range(v: Robots, names: list[str], b: Binding) -> tuple[int, int]:
    """First index and number of the names that belong to a robot.

    Raises:
        SceneError: If there is no such robot.
    """
    if v.of is None:
        return 0, len(names)
    robots = [e.name for e in b.layout.entities if e.kind == "robot"]
    if v.of not in robots:
        raise SceneError("no such robot", key=f"{b.key}.of", file=b.file, found=v.of, allowed=robots)
    own = [i for i, name in enumerate(names) if name.startswith(f"{v.of}/")]
    return own[0], len(own)


def dof_names(b: Binding) -> list[str]:
    """Name of the joint that each degree of freedom belongs to."""
    counts = b.layout.joint_dof_dim.sum(axis=1)
    return [name for name, count in zip(b.layout.joint_name, counts, strict=True) for _ in range(count)]


def named_dofs(v: Joints | JointLimit, b: Binding) -> list[int]:
    """Degrees of freedom of joints by name.

    Raises:
        SceneError: If there is no such joint, or one is named twice, or the robot, too.
    """
    where = f"{b.key}.joints"
    if v.of is not None:
        raise SceneError("name joints or their robot, not both: leave out 'of'", key=where, file=b.file, found=v.of)
    coords = [b.joint(name, "joints") for name in v.joints]
    if len(set(coords)) < len(coords):
        raise SceneError("a joint is named twice", key=where, file=b.file, found=list(v.joints))
    return [int(np.flatnonzero(b.layout.dof_coord == coord)[0]) for coord in coords]


def joint_dofs(v: Joints, b: Binding) -> list[int]:
    """Degrees of freedom of the named joints, or of a robot.

    Raises:
        SceneError: As :func:`named_dofs` and :func:`robot_range`.
    """
    if v.joints is not None:
        return named_dofs(v, b)
    robot = v.of or next(e.name for e in b.layout.entities if e.kind == "robot")
    first, count = robot_range(Robots(of=robot), dof_names(b), b)
    return list(range(first, first + count))
