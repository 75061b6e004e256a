# SPDX-License-Identifier: Apache-2.0
"""Spheres that cover the shapes of links: what geometric collision costs see of a robot.

Inputs of a check whether a robot's links meet: the joints that move them against each other, and shapes.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from .hulls import SPACING, Hull, directions, shape_hull, thinned

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from .layout import Entity, Layout, ShapeInfo


@dataclass(frozen=True)
class Group:
    """The spheres of one body, and a sphere around them all."""

    body: int
    first: int
    """First of its spheres; they stand one after the other, the larger ones first."""
    count: int
    centre: tuple[float, float, float]
    """Of the sphere around them, in the body's frame [m]."""
    radius: float
    """Of the sphere around them [m]."""


@dataclass(frozen=True)
class Spheres:
    """Spheres fixed to bodies, sorted by body; few of a body's differ in radius."""

    body: np.ndarray  # [n] int32
    centre: np.ndarray  # [n, 3] in the body's frame [m]
    radius: np.ndarray  # [n] [m]
    groups: tuple[Group, ...]
    """One for each body that has spheres, in the order of bodies."""

    def __len__(self) -> int:
        return len(self.radius)

    @classmethod
    def of(cls, rows: Mapping[int, np.ndarray]) -> Spheres:
        """Spheres from rows of x, y, z and radius for each body, ``[n, 4]`` [m]."""
        rows = {body: rows[body][np.argsort(-rows[body][:, 3], kind="stable")] for body in sorted(rows)}
        first = np.cumsum([0, *(len(r) for r in rows.values())])
        groups = tuple(
            Group(body, int(i), len(r), *_bound(r)) for i, (body, r) in zip(first, rows.items(), strict=False)
        )
        every = np.concatenate([np.zeros((0, 4)), *rows.values()]).astype(np.float32)
        body = np.repeat(np.array(list(rows), dtype=np.int32), [len(r) for r in rows.values()])
        return cls(body, every[:, :3].copy(), every[:, 3].copy(), groups)


def fit_spheres(
    layout: Layout,
    bodies: Sequence[int],
    *,
    overhang: float = 0.03,
    most: int = 8,
    given: Mapping[int, Sequence[Sequence[float]]] | None = None,
) -> Spheres:
    """Cover the colliding shapes of bodies with few spheres.

    The shapes of a body, meshes as their convex hulls, are covered; between the points that are looked at, up to 2 mm
    may stick out. Spheres are added one by one until they stick out little enough, or until more would not help. A
    body's spheres have one radius, or two where that lets much less stick out. The same layout gives the same spheres.

    Args:
        layout: Layout of the scene.
        bodies: Bodies to cover; those without colliding shapes get no spheres.
        overhang: How far 95 % of the spheres' surface may stick out of the shapes at most [m].
        most: Spheres of a body at most, even if they stick out farther.
        given: Spheres (x, y, z, radius) in place of fitted ones, by body [m].
    """
    given = given or {}
    rows = {}
    for body in sorted({*bodies}):
        if body in given:
            rows[body] = np.array(given[body], dtype=np.float64).reshape(-1, 4)
            continue
        shapes = [s for s in layout.shapes if s.body == body and s.collides and s.kind != "plane"]
        if shapes:
            rows[body] = _fitted(layout, shapes, overhang, most)
    return Spheres.of({body: r for body, r in rows.items() if len(r)})


_known: dict[bytes, np.ndarray] = {}
"""Spheres of shapes that were covered before: a controller and its plant ask for the same ones."""


def _fitted(layout: Layout, shapes: Sequence[ShapeInfo], overhang: float, most: int) -> np.ndarray:
    """Spheres of the shapes of a body ``[n, 4]``."""
    key = hashlib.sha256(repr((overhang, most)).encode())
    for shape in shapes:
        key.update(repr((shape.kind, shape.pose, shape.scale)).encode())
        if shape.mesh is not None:
            key.update(layout.meshes[shape.mesh][0].tobytes())
    if key.digest() not in _known:
        hulls = [shape_hull(layout, shape, SPACING) for shape in shapes]
        _known[key.digest()] = _cover(hulls, overhang, most)
    return _known[key.digest()]


_POINTS = 300
"""Points that centres are searched with; radii are found with all."""
_ROUNDS, _STEPS = 12, 12
_BETTER = 0.9
"""More spheres must stick out less than by this share of what fewer do."""
_ALIKE = 0.85
"""A second radius is worth having if it is less than this of the first."""
_PROBES = directions(64)
"""Where the surface of a sphere is looked at."""


def _cover(hulls: list[Hull], overhang: float, most: int) -> np.ndarray:
    """Spheres that cover hulls ``[n, 4]``."""
    corners = np.concatenate([hull.corners for hull in hulls])
    surface = np.concatenate([hull.surface for hull in hulls])
    # what is inside is covered, too: a thin wall may be there
    inside = np.concatenate([_shrunk(hull, share) for hull in hulls for share in (0.3, 0.65)])
    points = np.concatenate([corners, thinned(surface, step=0.5 * SPACING), inside])
    few = thinned(points, count=_POINTS)
    tree = cKDTree(surface)
    best, least = None, np.inf
    for count in range(1, most + 1):
        fits = [_fit(points, _centres(few, start)) for start in _starts(few, count)]
        scores = [np.quantile(_overhang(fit, hulls, tree), 0.95) for fit in fits]
        if min(scores) < _BETTER * least:
            best, least = fits[int(np.argmin(scores))], min(scores)
        if least <= overhang:
            break
    return best


def _starts(points: np.ndarray, count: int) -> list[np.ndarray]:
    """Starts of searches for centres: far apart, and one after the other along the longest axis ``[count, 3]``."""
    middle = points.mean(axis=0)
    if count == 1:
        return [middle[None]]
    distance, far = ((points - middle) ** 2).sum(axis=1), []
    for _ in range(count):
        far.append(points[distance.argmax()])
        distance = np.minimum(distance if len(far) > 1 else np.inf, ((points - far[-1]) ** 2).sum(axis=1))
    axis = np.linalg.eigh(np.cov(points.T))[1][:, 2]
    along = (points - middle) @ axis
    share = (np.arange(count) + 0.5) / count
    return [np.array(far), middle + (along.min() + share * np.ptp(along))[:, None] * axis]


def _centres(points: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Centres of equal spheres, as small as they can be, that cover points: a k-centre search from a start ``[n, 3]``.

    Points belong to the nearest centre; each centre goes on to that of the smallest ball around its points (Bădoiu and
    Clarkson 2003: steps of 1/(i + 1) towards the farthest), and again.
    """
    best, least = centres, np.inf
    norms = (points**2).sum(axis=1)[:, None]
    for _ in range(_ROUNDS):
        squared = norms - 2.0 * points @ centres.T + (centres**2).sum(axis=1)
        reach = squared.min(axis=1).max()
        if reach < least:
            best, least = centres, reach
        mine = squared.argmin(axis=1)[:, None] == np.arange(len(centres))
        far = np.where(mine, norms, -np.inf)
        centres = (mine.T @ points) / np.maximum(mine.sum(axis=0), 1)[:, None]
        for i in range(_STEPS):
            farthest = (far - 2.0 * points @ centres.T).argmax(axis=0)  # of its own points; |c|² is the same for all
            centres = centres + (points[farthest] - centres) / (i + 2.0)
    return best


def _fit(points: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Spheres about centres that cover points, of one radius or of two where they differ much ``[n, 4]``."""
    distance, owner = cKDTree(centres).query(points)
    need = np.zeros(len(centres))
    np.maximum.at(need, owner, distance)
    order = np.sort(need)
    large = order[-1]
    splits = [(k * order[k - 1] + (len(order) - k) * large, order[k - 1]) for k in range(1, len(order))]
    small = min(splits)[1] if splits else large
    small = small if small < _ALIKE * large else large
    return np.column_stack([centres, np.where(need <= small, small, large)])


def _overhang(spheres: np.ndarray, hulls: list[Hull], tree: cKDTree) -> np.ndarray:
    """Distances of points of the spheres' common surface outside the shapes [m]."""
    at = (spheres[:, None, :3] + spheres[:, None, 3:] * _PROBES).reshape(-1, 3)
    distance = np.linalg.norm(at[:, None] - spheres[:, :3], axis=2) - spheres[:, 3]
    outer = at[(distance > -1e-6).all(axis=1)]
    inside = np.max([hull.depth(outer) for hull in hulls], axis=0) >= 0.0
    return np.where(inside, 0.0, tree.query(outer)[0])


def _shrunk(hull: Hull, share: float) -> np.ndarray:
    """The surface of a hull drawn together towards its middle."""
    middle = hull.corners.mean(axis=0)
    return middle + share * (thinned(hull.surface, step=2.0 * SPACING) - middle)


def _bound(rows: np.ndarray) -> tuple[tuple[float, float, float], float]:
    """Centre and radius of a small sphere around spheres ``[n, 4]``."""
    centre = rows[0, :3]
    for i in range(200):
        away = rows[:, :3] - centre
        distance = np.linalg.norm(away, axis=1)
        k = (distance + rows[:, 3]).argmax()
        centre = centre + away[k] * (1.0 + rows[k, 3] / max(distance[k], 1e-9)) / (i + 2.0)
    centre = np.float32(centre).astype(np.float64)
    # a hair more, for numbers of single precision
    return tuple(centre.tolist()), float((np.linalg.norm(rows[:, :3] - centre, axis=1) + rows[:, 3]).max() + 1e-6)


_DIGITS = 5
"""Digits of lengths and angles that are compared."""


def self_moving_dofs(layout: Layout, bodies: Collection[int]) -> list[int]:
    """Degrees of freedom that move some of these bodies against others, those with their own coordinate.

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
