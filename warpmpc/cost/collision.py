# SPDX-License-Identifier: Apache-2.0
"""The collision terms: their keys in scene files, and how they become spheres, pairs and obstacles."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..kernels.terms import collision
from ..model.layout import WORLD, Entity
from ..model.link_pairs import moving_bodies, self_pairs
from ..model.spheres import Spheres, fit_spheres
from ..scene.errors import SceneError
from ..scene.types import Names, NonNegative, Positive, Section
from .binding import PRIMITIVES
from .mesh_volumes import mesh_volumes
from .native import collision as native
from .term import CostTerm, parse_keys

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..model.layout import ShapeInfo
    from .binding import Binding


class CollisionForm(StrEnum):
    """Cost of a collision."""

    DISTANCE = "distance"
    BINARY = "binary"


class SelfCollision(Section):
    """Deepest penetration of a robot's links into each other, as spheres: max(0, margin + depth) [m]."""

    of: str | None = None
    """Robot; all robots, also against each other, when left out."""
    margin: NonNegative = 0.0
    """Links closer than this cost something [m]."""
    ignore: tuple[tuple[str, str], ...] = ()
    """Pairs of links, ``robot/link`` or the link's own name, that are left out besides those that cannot collide."""
    include: tuple[tuple[str, str], ...] = ()
    """Pairs of links that count in any case."""
    overhang: Positive = 0.03
    """How far the spheres may stick out of the links [m]: less takes more spheres."""


class WorldCollision(Section):
    """Least distance of a robot's links, as spheres, from obstacles: max(0, margin - d) [m], or 1 if d < margin."""

    of: str | None = None
    """Robot; all robots when left out."""
    links: Names | None = None
    """Links, ``robot/link`` or the link's own name; all that joints move when left out."""
    against: Names = ("obstacles",)
    """Obstacles, objects, ``ground``, or the groups obstacles and objects."""
    form: CollisionForm = CollisionForm.DISTANCE
    """distance: max(0, margin - d); binary: 1 if d < margin, else 0."""
    margin: NonNegative = 0.0
    """Obstacles closer than this cost something [m]."""
    swept: bool = False
    """Look at the straight way of every sphere from the step before, so that no thin wall is jumped over."""
    overhang: Positive = 0.03
    """How far the spheres may stick out of the links [m]: less takes more spheres."""
    voxel: Positive | None = None
    """Edge of the voxels of meshes' distance volumes [m]; chosen by the size of each mesh when left out."""


def find_robots(of: str | None, b: Binding) -> list[Entity]:
    """The robots a term is about.

    Raises:
        SceneError: If there is no such robot.
    """
    robots = [entity for entity in b.layout.entities if entity.kind == "robot"]
    if of is None:
        return robots
    names = [robot.name for robot in robots]
    if of not in names:
        raise SceneError("no such robot", key=f"{b.key}.of", file=b.file, found=of, allowed=names)
    return [robots[names.index(of)]]


def _link(name: str, bodies: Sequence[int], b: Binding, key: str) -> int:
    """Body of a link, by ``robot/link`` or the link's own name where unique."""
    full = {b.layout.body_name[body]: body for body in bodies}
    found = [body for label, body in full.items() if name in (label, label.partition("/")[2])]
    if len(found) != 1:
        what = "several links have this name" if found else "no such link"
        raise SceneError(what, key=key, file=b.file, found=name, allowed=full)
    return found[0]


def _spheres(robots: Sequence[Entity], bodies: Sequence[int], overhang: float, b: Binding) -> Spheres:
    """Spheres of some bodies: the scene's own where it has them, else fitted ones."""
    given = {}
    for robot in robots:
        for name, rows in next(r for r in b.scene.robot if r.name == robot.name).spheres.items():
            given[_link(name, robot.bodies, b, f"robot.{robot.name}.spheres.{name}")] = rows
    spheres = fit_spheres(b.layout, bodies, overhang=overhang, given=given)
    if not len(spheres):
        raise SceneError(
            f"these links have no shape that collides: give them spheres = {{ link = [[x, y, z, radius]] }} in "
            f"[[robot]] '{robots[0].name}'",
            key=b.key,
            file=b.file,
            found=[b.layout.body_name[body] for body in bodies],
        )
    return spheres


def moving_links(robots: Sequence[Entity], links: Sequence[str] | None, b: Binding) -> list[int]:
    """Bodies of the links a term names, or of all that joints move.

    Raises:
        SceneError: If there is no such link.
    """
    bodies = [body for robot in robots for body in robot.bodies]
    if links is not None:
        return [_link(name, bodies, b, f"{b.key}.links") for name in links]
    moving = moving_bodies(b.layout)
    return [body for body in bodies if body in moving]


def sphere_table(robots: Sequence[Entity], bodies: Sequence[int], overhang: float, b: Binding) -> collision.SphereTable:
    """Spheres of some bodies as kernels take them.

    Raises:
        SceneError: If none of the bodies has spheres.
    """
    return _table(_spheres(robots, bodies, overhang, b), b)


def _table(spheres: Spheres, b: Binding) -> collision.SphereTable:
    groups = spheres.groups
    table = collision.SphereTable()
    table.centre, table.radius = b.array(spheres.centre, wp.vec3), b.array(spheres.radius, float)
    for name in ("body", "first", "count"):
        setattr(table, name, b.array([getattr(group, name) for group in groups], int))
    table.bound_centre = b.array(np.array([group.centre for group in groups], dtype=np.float32), wp.vec3)
    table.bound_radius = b.array([group.radius for group in groups], float)
    return table


def _self_collision(keys: dict[str, Any], b: Binding) -> collision.SelfCollisionParams:
    v = parse_keys(SelfCollision, keys, b)
    robots = find_robots(v.of, b)
    bodies = [body for robot in robots for body in robot.bodies]
    spheres = _spheres(robots, bodies, v.overhang, b)
    named = {}
    for key in ("ignore", "include"):
        named[key] = [tuple(_link(name, bodies, b, f"{b.key}.{key}") for name in pair) for pair in getattr(v, key)]
        for names, pair in zip(getattr(v, key), named[key], strict=True):
            covered = {group.body for group in spheres.groups}
            if pair[0] == pair[1] or not {*pair} <= covered:
                what = "a link does not collide with itself" if pair[0] == pair[1] else "a link without spheres"
                raise SceneError(what, key=f"{b.key}.{key}", file=b.file, found=list(names))
    pairs = np.array(self_pairs(b.layout, spheres, margin=v.margin, **named), dtype=np.int32).reshape(-1, 2)
    p = collision.SelfCollisionParams()
    p.spheres, p.margin = _table(spheres, b), v.margin
    p.first, p.second = (b.array(np.ascontiguousarray(side), int) for side in pairs.T)
    return p


def _obstacles(names: Sequence[str], b: Binding) -> list[tuple[int, ShapeInfo]]:
    """Colliding shapes of entities, each with its body: a pose of the task for those that move with it."""
    shapes = []
    for name in dict.fromkeys(names):
        try:
            entities = b.layout.group(name)
        except SceneError as error:
            raise SceneError(
                "no such obstacle or object",
                key=f"{b.key}.against",
                file=b.file,
                found=name,
                allowed=["obstacles", "objects", *(e.name for e in b.layout.entities if e.kind != "robot")],
            ) from error
        for entity in entities:
            if entity.kind == "robot":
                raise SceneError(
                    "a robot is no obstacle: self_collision knows of links against links",
                    key=f"{b.key}.against",
                    file=b.file,
                    found=name,
                )
            own = [b.layout.shapes[i] for i in entity.shapes]
            shapes += [(_body_of(entity, shape, b), shape) for shape in own if shape.collides]
    return shapes


def _body_of(entity: Entity, shape: ShapeInfo, b: Binding) -> int:
    return int(b.layout.frame_body[b.layout.frame(entity.name)]) if entity.movable else shape.body


def _world_collision(keys: dict[str, Any], b: Binding) -> collision.WorldCollisionParams:
    v = parse_keys(WorldCollision, keys, b)
    robots = find_robots(v.of, b)
    p = collision.WorldCollisionParams()
    p.spheres = sphere_table(robots, moving_links(robots, v.links, b), v.overhang, b)
    p.margin, p.binary, p.swept = v.margin, int(v.form is CollisionForm.BINARY), int(v.swept)
    obstacles = _obstacles(v.against, b)
    kinds = [_KINDS.get(shape.kind) for _, shape in obstacles]
    if None in kinds:
        found = obstacles[kinds.index(None)][1]
        raise SceneError(
            f"no distance to a shape of this kind: it takes {', '.join(_KINDS)}",
            key=f"{b.key}.against",
            file=b.file,
            found=f"{found.entity}: {found.kind}",
        )
    p.body, p.kind = (b.array(np.array(x, dtype=np.int32), int) for x in ([body for body, _ in obstacles], kinds))
    poses = [_local(body, shape) for body, shape in obstacles]
    p.pose = b.array(np.array(poses, dtype=np.float32).reshape(-1, 7), wp.transform)
    sizes = [(0.0, 0.0, 0.0) if s.kind == "mesh" else s.scale for _, s in obstacles]
    p.size = b.array(np.array(sizes, dtype=np.float32).reshape(-1, 3), wp.vec3)
    # a sphere whose centre is outside a volume costs nothing
    reach = v.margin + float(p.spheres.radius.numpy().max())
    p.volumes, index = mesh_volumes([s for _, s in obstacles], reach, v.voxel, b)
    p.mesh = b.array(np.array(index, dtype=np.int32), int)
    return p


_KINDS = {**PRIMITIVES, "mesh": int(collision.MESH)}


def _local(body: int, shape: ShapeInfo) -> tuple[float, ...]:
    """Pose of a shape in its body's frame; one that moves with the task is its own body."""
    return shape.pose if body >= WORLD else (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


TERMS = (
    CostTerm(
        "self_collision",
        collision.self_collision,
        collision.SelfCollisionParams,
        _self_collision,
        SelfCollision,
        native.self_collision,
    ),
    CostTerm(
        "world_collision",
        collision.world_collision,
        collision.WorldCollisionParams,
        _world_collision,
        WorldCollision,
        native.world_collision,
    ),
)
