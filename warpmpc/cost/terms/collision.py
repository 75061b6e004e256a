# SPDX-License-Identifier: Apache-2.0
"""Collision terms: spheres that cover a robot's links against each other and against the world."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from ...kernels.cost.points import MESH, shape_distance
from ...kernels.cost.view import TASK_BODY, StepView
from ...kernels.geometry.volume import MeshVolumes, mesh_distance
from ...scene.errors import SceneError
from ...scene.model.layout import WORLD, Entity, ShapeInfo
from ...scene.model.pairs import self_pairs
from ...scene.types import Names, NonNegative, Positive
from ..binding import PRIMITIVES, Binding
from ..code import collision as source
from ..keys import TermKeys, term
from .mesh_volumes import mesh_volumes
from .spheres import LinkKeys, SphereTable, fitted, link_body, table_of

_FINENESS = wp.constant(0.25)
"""Least advance along a swept sphere's way, as a share of its radius."""
_KINDS = {**PRIMITIVES, "mesh": int(MESH)}


class SelfCollision(TermKeys):
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

    derived = {"spheres": SphereTable, "first": wp.array[int], "second": wp.array[int]}

    def bind(self, p: Any, b: Binding) -> None:
        """Find spheres of links, and pairs of groups of them."""
        robots = b.robots(self.of)
        bodies = [body for robot in robots for body in robot.bodies]
        spheres = fitted(robots, bodies, self.overhang, b)
        named = {}
        for key in ("ignore", "include"):
            named[key] = [
                tuple(link_body(name, bodies, b, f"{b.key}.{key}") for name in pair) for pair in getattr(self, key)
            ]
            for names, pair in zip(getattr(self, key), named[key], strict=True):
                covered = {group.body for group in spheres.groups}
                if pair[0] == pair[1] or not {*pair} <= covered:
                    what = "a link does not collide with itself" if pair[0] == pair[1] else "a link without spheres"
                    raise b.error(what, key, found=list(names))
        pairs = np.array(self_pairs(b.layout, spheres, margin=self.margin, **named), dtype=np.int32).reshape(-1, 2)
        p.spheres = table_of(spheres, b)
        p.first, p.second = (b.array(np.ascontiguousarray(side), int) for side in pairs.T)


@term("self_collision", SelfCollision, source=source.self_collision)
def self_collision(s: StepView, p: SelfCollision.Params) -> float:
    """Penetration of links into each other, max(0, margin + d), d deepest of their spheres, negative if apart [m].

    The self-collision cost of Bhardwaj et al. 2021, with d from geometry instead of a network.
    """
    deepest = -p.margin
    for k in range(p.first.shape[0]):
        a = p.first[k]
        b = p.second[k]
        pose_a = s.body_q[s.t, s.w, p.spheres.body[a]]
        pose_b = s.body_q[s.t, s.w, p.spheres.body[b]]
        # where all of b's are seen from a's body: one turn less for each sphere
        seen = wp.transform_inverse(pose_a) * pose_b
        apart = wp.length(p.spheres.bound_centre[a] - wp.transform_point(seen, p.spheres.bound_centre[b]))
        if p.spheres.bound_radius[a] + p.spheres.bound_radius[b] - apart <= deepest:
            continue
        for j in range(p.spheres.first[b], p.spheres.first[b] + p.spheres.count[b]):
            centre = wp.transform_point(seen, p.spheres.centre[j])
            for i in range(p.spheres.first[a], p.spheres.first[a] + p.spheres.count[a]):
                depth = p.spheres.radius[i] + p.spheres.radius[j] - wp.length(p.spheres.centre[i] - centre)
                deepest = wp.max(deepest, depth)
    return deepest + p.margin


def _obstacles(names: Sequence[str], b: Binding) -> list[tuple[int, ShapeInfo]]:
    """Colliding shapes of entities, each with its body: a pose of the task for those that move with it."""
    shapes = []
    for name in dict.fromkeys(names):
        try:
            entities = b.layout.group(name)
        except SceneError as error:
            raise b.error(
                "no such obstacle or object",
                "against",
                found=name,
                allowed=["obstacles", "objects", *(e.name for e in b.layout.entities if e.kind != "robot")],
            ) from error
        for entity in entities:
            if entity.kind == "robot":
                raise b.error(
                    "a robot is no obstacle: self_collision knows of links against links", "against", found=name
                )
            own = [b.layout.shapes[i] for i in entity.shapes]
            shapes += [(_body_of(entity, shape, b), shape) for shape in own if shape.collides]
    return shapes


def _body_of(entity: Entity, shape: ShapeInfo, b: Binding) -> int:
    return int(b.layout.frame_body[b.layout.frame(entity.name)]) if entity.movable else shape.body


def _local(body: int, shape: ShapeInfo) -> tuple[float, ...]:
    """Pose of a shape in its body's frame; one that moves with the task is its own body."""
    return shape.pose if body >= WORLD else (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


class WorldCollision(LinkKeys):
    """Least distance of a robot's links, as spheres, from obstacles: max(0, margin - d) [m], or 1 if d < margin."""

    against: Names = ("obstacles",)
    """Obstacles, objects, ``ground``, or the groups obstacles and objects."""
    swept: bool = False
    """Look at the straight way of every sphere from the step before, so that no thin wall is jumped over."""
    voxel: Positive | None = None
    """Edge of the voxels of meshes' distance volumes [m]; chosen by the size of each mesh when left out."""

    derived = LinkKeys.derived | {
        "body": wp.array[int],  # [obstacles] body, -1 world, -2 and below poses of the task
        "pose": wp.array[wp.transform],  # [obstacles] shape in the body's frame
        "kind": wp.array[int],  # [obstacles]
        "size": wp.array[wp.vec3],  # [obstacles] half extents or (radius, half length)
        "mesh": wp.array[int],  # [obstacles] which of the volumes, of those that are meshes
        "volumes": MeshVolumes,
    }

    def bind(self, p: Any, b: Binding) -> None:
        """Find spheres of links, and the obstacles' shapes."""
        super().bind(p, b)
        obstacles = _obstacles(self.against, b)
        kinds = [_KINDS.get(shape.kind) for _, shape in obstacles]
        if None in kinds:
            found = obstacles[kinds.index(None)][1]
            raise b.error(
                f"no distance to a shape of this kind: it takes {', '.join(_KINDS)}",
                "against",
                found=f"{found.entity}: {found.kind}",
            )
        p.body, p.kind = (b.array(np.array(x, dtype=np.int32), int) for x in ([body for body, _ in obstacles], kinds))
        p.pose = b.array([_local(body, shape) for body, shape in obstacles], wp.transform)
        p.size = b.array([(0.0, 0.0, 0.0) if s.kind == "mesh" else s.scale for _, s in obstacles], wp.vec3)
        # a sphere whose centre is outside a volume costs nothing
        reach = self.margin + float(p.spheres.radius.numpy().max())
        p.volumes, index = mesh_volumes([s for _, s in obstacles], reach, self.voxel, b)
        p.mesh = b.array(np.array(index, dtype=np.int32), int)


@wp.func
def obstacle_pose(s: StepView, p: WorldCollision.Params, k: int, t: int) -> wp.transform:
    """World pose of an obstacle's shape at slice t."""
    body = p.body[k]
    if body <= TASK_BODY:
        return s.pose[s.e, TASK_BODY - body] * p.pose[k]
    if body < 0:
        return p.pose[k]
    return s.body_q[t, s.w, body] * p.pose[k]


@wp.func
def obstacle_distance(p: WorldCollision.Params, k: int, at: wp.vec3) -> float:
    """Signed distance from a point in an obstacle's frame to its surface [m]; of meshes far away a bound below it."""
    if p.kind[k] == MESH:
        return mesh_distance(p.volumes, p.mesh[k], at)
    return shape_distance(p.kind[k], p.size[k], at)


@wp.func
def least_on_way(p: WorldCollision.Params, k: int, a: wp.vec3, b: wp.vec3, radius: float, least: float) -> float:
    """Least of a bound and the distances of a sphere on its straight way from a to b in an obstacle's frame [m].

    Distances change no faster than the sphere moves. So it is moved on by as much as its distance is above the least
    so far, and by a quarter of its radius at least: nothing is skipped however thin it is, and what is found is at most
    an eighth of the radius above the true minimum.
    """
    length = wp.length(b - a)
    way = wp.float32(0.0)
    # backwards, so that a sphere that rests is looked at where it is
    while way <= length:
        at = b
        if way > 0.0:
            at = b + (way / length) * (a - b)
        d = obstacle_distance(p, k, at) - radius
        step = wp.max(d - least, _FINENESS * radius)
        least = wp.min(least, d)
        if way < length:
            way = wp.min(way + step, length)
        else:
            way = length + 1.0
    return least


@term("world_collision", WorldCollision, source=source.world_collision)
def world_collision(s: StepView, p: WorldCollision.Params) -> float:
    """Nearness of links to obstacles, max(0, margin - d), d least of their spheres [m]; or 1 if d < margin, else 0.

    The second is the binary cost of Bhardwaj et al. 2021, Eq. 11, without its learned checker.
    """
    least = p.margin
    for k in range(p.body.shape[0]):
        from_world = wp.transform_inverse(obstacle_pose(s, p, k, s.t))
        from_world_before = from_world
        if p.swept != 0:
            from_world_before = wp.transform_inverse(obstacle_pose(s, p, k, s.t - 1))
        for g in range(p.spheres.body.shape[0]):
            body = p.spheres.body[g]
            now = from_world * s.body_q[s.t, s.w, body]
            before = now
            if p.swept != 0:
                before = from_world_before * s.body_q[s.t - 1, s.w, body]
            # the group's sphere, or a sphere around it here and there, of which one half is the way between
            here = wp.transform_point(now, p.spheres.bound_centre[g])
            there = wp.transform_point(before, p.spheres.bound_centre[g])
            bound = p.spheres.bound_radius[g] + 0.5 * wp.length(here - there)
            if obstacle_distance(p, k, 0.5 * (here + there)) - bound >= least:
                continue
            for i in range(p.spheres.first[g], p.spheres.first[g] + p.spheres.count[g]):
                a = wp.transform_point(now, p.spheres.centre[i])
                radius = p.spheres.radius[i]
                if p.swept != 0:
                    least = least_on_way(p, k, wp.transform_point(before, p.spheres.centre[i]), a, radius, least)
                else:
                    least = wp.min(least, obstacle_distance(p, k, a) - radius)
            if p.binary != 0 and least < p.margin:
                return 1.0
    return p.margin - least
