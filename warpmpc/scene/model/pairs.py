# SPDX-License-Identifier: Apache-2.0
"""Pairs of robots' links that may collide with each other, seen by the spheres that cover them.

Pairs of entities whose contact force is watched, on the host and on a device.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ...kernels.engine.contacts import PairTable
from ...kernels.geometry.kinematics import forward_kinematics_kernel
from .hulls import SPACING, shape_hull, thinned
from .joints import joint_table
from .layout import rotate

if TYPE_CHECKING:
    from collections.abc import Collection

    from .layout import Layout
    from .spheres import Spheres

_FIXED = 3
"""Newton's number of a joint without axes."""
_POSTURES = 400
"""Postures that are looked at, drawn within the limits."""
_ALWAYS = 0.95
"""Spheres of links that overlap in at least this share of them say nothing."""
_OFTEN = 0.2
"""Spheres that overlap in this share of them should be right at times."""
_LOOKS = 60
"""Postures in which the shapes themselves are compared."""
_POINTS = 200
"""Points of each shape's surface that are compared."""


def self_pairs(
    layout: Layout,
    spheres: Spheres,
    *,
    margin: float = 0.0,
    ignore: Collection[tuple[int, int]] = (),
    include: Collection[tuple[int, int]] = (),
) -> list[tuple[int, int]]:
    """Groups of spheres whose links may collide with each other, the lower index first.

    All pairs of groups, but for those

    - of links that no joint moves against each other, or that one joint (or several with no shape between) connects;
    - whose spheres overlap in 95 % or more of 400 postures drawn within the limits (the same ones every time);
    - whose spheres overlap at the start, or in 20 % or more of these postures, where their shapes, as convex hulls, do
      not (looked at in 60 of them at most): spheres say too much of these links, such as a forearm and a wrist.

    Args:
        layout: Layout of the scene.
        spheres: Spheres of the robots.
        margin: Spheres that are closer than this count as overlapping [m].
        ignore: Pairs of bodies to leave out besides.
        include: Pairs of bodies to add, whatever is said above.
    """
    groups = spheres.groups
    ignore, include = ({frozenset(pair) for pair in pairs} for pairs in (ignore, include))
    link, above = _rigid(layout, {group.body for group in groups})
    poses = _postures(layout)
    centre = _placed(poses, spheres.body, spheres.centre.astype(np.float64))
    pairs = []
    for a, b in itertools.combinations(range(len(groups)), 2):
        bodies = (groups[a].body, groups[b].body)
        if {*bodies} in include:
            pairs.append((a, b))
            continue
        links = (link[bodies[0]], link[bodies[1]])
        if {*bodies} in ignore or links[0] == links[1] or above[links[0]] == links[1] or above[links[1]] == links[0]:
            continue
        overlap = _overlap(spheres, centre, a, b, margin)
        often = np.flatnonzero(overlap[1:])
        if len(often) >= _ALWAYS * _POSTURES or (overlap[0] and not _touch(layout, bodies, poses[:1])):
            continue
        if len(often) < _OFTEN * _POSTURES or _touch(layout, bodies, poses[1 + often[:_LOOKS]]):
            pairs.append((a, b))
    return pairs


def moving_bodies(layout: Layout) -> set[int]:
    """Bodies that a joint moves in the world."""
    moving: set[int] = set()
    for kind, up, child in zip(layout.joint_type, layout.joint_parent, layout.joint_child, strict=True):
        if kind != _FIXED or up in moving:
            moving.add(int(child))
    return moving


def _rigid(layout: Layout, covered: Collection[int]) -> tuple[dict[int, int], dict[int, int]]:
    """Groups of bodies that move as one (their first body), and the next covered one above each (-1 for none)."""
    link = {body: body for body in range(layout.nb)}
    parent = {}
    for kind, up, child in zip(layout.joint_type, layout.joint_parent, layout.joint_child, strict=True):
        if kind == _FIXED and up >= 0:
            link[int(child)] = link[int(up)]
        else:
            parent[int(child)] = int(up)
    solid = {link[body] for body in covered}
    above = {}
    for body in solid:
        up = parent.get(body, -1)
        while up >= 0 and link[up] not in solid:
            up = parent.get(link[up], -1)
        above[body] = link[up] if up >= 0 else -1
    return link, above


def _postures(layout: Layout) -> np.ndarray:
    """Body poses at the start and in postures within the limits ``[1 + postures, nb, 7]``."""
    span = layout.dof_upper - layout.dof_lower
    bounded = (span > 0.0) & (span < 1e6)
    angular = np.concatenate([[*[False] * a, *[True] * b] for a, b in layout.joint_dof_dim] or [[]]).astype(bool)
    lower = np.where(bounded, layout.dof_lower, -np.pi)
    upper = np.where(bounded, layout.dof_upper, np.pi)
    q = np.tile(layout.joint_q, (1 + _POSTURES, 1))
    drawn = np.random.default_rng(0).uniform(lower, upper, size=(_POSTURES, layout.nv))
    for dof in np.flatnonzero((layout.dof_coord >= 0) & (bounded | angular)):
        q[1:, layout.dof_coord[dof]] = drawn[:, dof]
    body_q = wp.zeros((1, len(q), layout.nb), dtype=wp.transform, device="cpu")
    inputs = [wp.array(a[None], dtype=float, device="cpu") for a in (q, np.zeros((len(q), layout.nv)))]
    outputs = [body_q, wp.zeros(body_q.shape, dtype=wp.spatial_vector, device="cpu")]
    table = joint_table(layout, "cpu", worlds=len(q))
    wp.launch(forward_kinematics_kernel, body_q.shape[:2], inputs=[table, *inputs], outputs=outputs, device="cpu")
    return body_q.numpy()[0].astype(np.float64)


def _placed(poses: np.ndarray, body: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points ``[n, 3]`` of bodies in the world, ``[postures, n, 3]``."""
    at = poses[:, body]
    return at[..., :3] + rotate(at[..., 3:], points)


def _overlap(spheres: Spheres, centre: np.ndarray, a: int, b: int, margin: float) -> np.ndarray:
    """Return whether spheres of two groups are closer than a margin ``[postures]``."""
    first, second = (slice(g.first, g.first + g.count) for g in (spheres.groups[a], spheres.groups[b]))
    apart = np.linalg.norm(centre[:, first, None] - centre[:, None, second], axis=3)
    return (apart < spheres.radius[first, None] + spheres.radius[second] + margin).any(axis=(1, 2))


def _touch(layout: Layout, bodies: tuple[int, int], poses: np.ndarray) -> bool:
    """Return whether shapes of two bodies overlap in one of some postures: points of one are inside the other."""
    hulls = []
    for body in bodies:
        shapes = [s for s in layout.shapes if s.body == body and s.collides and s.kind != "plane"]
        hulls.append([shape_hull(layout, shape, SPACING) for shape in shapes])
    if not all(hulls):
        return True  # the user's own spheres are all there is
    points = [np.concatenate([thinned(hull.surface, count=_POINTS) for hull in side]) for side in hulls]
    for pose in poses:
        for mine, other in ((0, 1), (1, 0)):
            placed = rotate(pose[bodies[mine], 3:], points[mine]) + pose[bodies[mine], :3]
            back = pose[bodies[other], 3:] * [-1.0, -1.0, -1.0, 1.0]
            local = rotate(back, placed - pose[bodies[other], :3])
            if any((hull.depth(local) > 0.0).any() for hull in hulls[other]):
                return True
    return False


@dataclass(frozen=True)
class Pair:
    """Two entities whose net contact force is watched; forces act on the first."""

    first: str
    second: str


def collision_pairs(layout: Layout, supports: Collection[str] = ()) -> tuple[Pair, ...]:
    """Robots against each other, and every robot and object against every obstacle: what reports call collisions.

    Args:
        layout: Layout of the scene.
        supports: Obstacles that objects lie on; against these, robots alone count.
    """
    robots, objects, obstacles = (layout.group(name) for name in ("robots", "objects", "obstacles"))
    crashes = tuple(Pair(a.name, b.name) for a, b in itertools.combinations(robots, 2))
    return crashes + tuple(
        Pair(m.name, o.name) for m in robots + objects for o in obstacles if m in robots or o.name not in supports
    )


def touching_pairs(layout: Layout) -> tuple[Pair, ...]:
    """Every object against every robot and against the other objects: contacts that a task may be about."""
    robots, objects = layout.group("robots"), layout.group("objects")
    pairs = (*itertools.product(robots, objects), *itertools.combinations(objects, 2))
    return tuple(Pair(a.name, b.name) for a, b in pairs)


def pair_table(layout: Layout, pairs: tuple[Pair, ...], shapes: list[int], device: str) -> PairTable:
    """The watched pairs on a device.

    Args:
        layout: Layout of one world.
        pairs: Watched pairs.
        shapes: Layout shape of each shape (or geom) of the solver, -1 for none.
        device: Warp device.
    """
    names = [e.name for e in layout.entities]
    owner = {s: i for i, e in enumerate(layout.entities) for s in e.shapes}
    table = PairTable()
    table.shape_entity = wp.array([owner.get(s, -1) for s in shapes], dtype=int, device=device)
    table.first = wp.array([names.index(p.first) for p in pairs], dtype=int, device=device)
    table.second = wp.array([names.index(p.second) for p in pairs], dtype=int, device=device)
    return table
