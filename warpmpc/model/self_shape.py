# SPDX-License-Identifier: Apache-2.0
"""Inputs of a check whether a robot's links meet: the joints that move them against each other, and shapes."""

from __future__ import annotations

import hashlib
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from .layout import Entity, Layout, ShapeInfo

_DIGITS = 5
"""Digits of lengths and angles that are compared."""


def self_moving_dofs(layout: Layout, bodies: Collection[int]) -> list[int]:
    """Degrees of freedom that move some of these bodies against others, those with a coordinate of their own.

    Args:
        layout: Layout of the scene.
        bodies: Bodies that have shapes.
    """
    moves: dict[int, set[int]] = {}
    parent = dict(zip(layout.joint_child.tolist(), range(len(layout.joint_child)), strict=True))
    for body in bodies:
        up = body
        while up >= 0:
            joint = parent[up]
            first = int(layout.joint_qd_start[joint])
            for dof in range(first, first + int(layout.joint_dof_dim[joint].sum())):
                moves.setdefault(dof, set()).add(body)
            up = int(layout.joint_parent[joint])
    return [dof for dof in sorted(moves) if layout.dof_coord[dof] >= 0 and len(moves[dof]) < len({*bodies})]


def colliding_bodies(layout: Layout, robot: Entity, given: Mapping[str, Sequence] = ()) -> list[int]:
    """Bodies of a robot with shapes that collide, or with spheres in the scene file."""
    shaped = {shape.body for shape in layout.shapes if shape.collides}
    named = {f"{robot.name}/{name.removeprefix(robot.name + '/')}" for name in given}
    return [body for body in robot.bodies if body in shaped or layout.body_name[body] in named]


def self_fingerprint(layout: Layout, robot: Entity, dofs: Collection[int], given: Mapping[str, Sequence] = ()) -> str:
    """A number in hexadecimal that is another one where links, their shapes or what holds the other joints are others.

    Where the robot stands and what it is called do not matter.

    Args:
        layout: Layout of the scene.
        robot: The robot.
        dofs: Degrees of freedom that may be anywhere within their limits; the others are held at the start.
        given: Spheres of the scene file, by link.
    """
    said = hashlib.sha256()
    say = partial(_say, said)

    def name(body: int) -> str:
        return layout.body_name[body].partition("/")[2] if body in robot.bodies else ""

    bodies = colliding_bodies(layout, robot, given)
    needed = self_moving_dofs(layout, bodies)
    for joint, (up, child) in enumerate(zip(layout.joint_parent, layout.joint_child, strict=True)):
        if int(child) not in robot.bodies:
            continue
        say(name(int(child)), name(int(up)), int(layout.joint_type[joint]), layout.joint_pose_child[joint])
        if int(up) in robot.bodies:
            say(layout.joint_pose_parent[joint])
        first = int(layout.joint_qd_start[joint])
        for dof in range(first, first + int(layout.joint_dof_dim[joint].sum())):
            say(layout.dof_axis[dof])
            if dof in dofs:
                say("moves", np.clip([layout.dof_lower[dof], layout.dof_upper[dof]], -1e6, 1e6))
            elif dof in needed:
                say("held", layout.joint_q[layout.dof_coord[dof]])
    for shape in layout.shapes:
        if shape.collides and shape.body in robot.bodies:
            say(name(shape.body), *_shape(layout, shape))
    for link in sorted(given):
        say(link.removeprefix(robot.name + "/"), np.array(given[link]))
    return said.hexdigest()[:16]


def link_fingerprint(layout: Layout, body: int) -> str:
    """A number in hexadecimal that is another one where the shapes of a link that collide are others."""
    said = hashlib.sha256()
    for shape in layout.shapes:
        if shape.collides and shape.body == body:
            _say(said, *_shape(layout, shape))
    return said.hexdigest()[:16]


def _shape(layout: Layout, shape: ShapeInfo) -> tuple:
    mesh = () if shape.mesh is None else layout.meshes[shape.mesh]
    return shape.kind, np.array(shape.pose), np.array(shape.scale), *mesh


def _say(said: hashlib._Hash, *values: object) -> None:
    """Add values to a hash."""
    for value in values:
        if isinstance(value, np.ndarray):  # no minus zeros
            value = (np.round(value.astype(np.float64), _DIGITS) + 0.0).tolist()
        said.update(repr(value).encode())
