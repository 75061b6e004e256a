# SPDX-License-Identifier: Apache-2.0
"""Geometric collision costs: spheres that cover a robot's links against each other and against the world."""

import warp as wp

from ..geometry.mesh_volume import MeshVolumes, mesh_distance
from .clearance import shape_distance
from .view import TASK_BODY, StepView

wp.set_module_options({"enable_backward": False})

MESH = wp.constant(5)
"""Kind of a shape whose distance a volume tells; those before it are ``clearance.shape_distance``'s."""
_FINENESS = wp.constant(0.25)
"""Least advance along a swept sphere's way, as a share of its radius."""


@wp.struct
class SphereTable:
    """Spheres of links, in groups of one body each."""

    centre: wp.array[wp.vec3]  # [n] in the body's frame [m]
    radius: wp.array[float]  # [n] [m]
    body: wp.array[int]  # [groups]
    first: wp.array[int]  # [groups] first sphere
    count: wp.array[int]  # [groups]
    bound_centre: wp.array[wp.vec3]  # [groups] of a sphere around the group's, in the body's frame [m]
    bound_radius: wp.array[float]  # [groups] [m]


@wp.struct
class SelfCollisionParams:
    """Parameters of ``self_collision``."""

    spheres: SphereTable
    first: wp.array[int]  # [pairs] group
    second: wp.array[int]  # [pairs] group
    margin: float  # [m]


@wp.func
def self_collision(s: StepView, p: SelfCollisionParams) -> float:
    """max(0, margin + d) with d the deepest penetration of two links' spheres, negative when all are apart [m].

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


@wp.struct
class WorldCollisionParams:
    """Parameters of ``world_collision``."""

    spheres: SphereTable
    body: wp.array[int]  # [obstacles] body, -1 world, -2 and below poses of the task
    pose: wp.array[wp.transform]  # [obstacles] shape in the body's frame
    kind: wp.array[int]  # [obstacles]
    size: wp.array[wp.vec3]  # [obstacles] half extents or (radius, half length)
    mesh: wp.array[int]  # [obstacles] which of the volumes, of those that are meshes
    volumes: MeshVolumes
    margin: float  # [m]
    binary: int  # 1 below the margin instead of how far below it
    swept: int  # look at the whole way from the step before


@wp.func
def obstacle_pose(s: StepView, p: WorldCollisionParams, k: int, t: int) -> wp.transform:
    """World pose of an obstacle's shape at slice t."""
    body = p.body[k]
    if body <= TASK_BODY:
        return s.pose[s.e, TASK_BODY - body] * p.pose[k]
    if body < 0:
        return p.pose[k]
    return s.body_q[t, s.w, body] * p.pose[k]


@wp.func
def obstacle_distance(p: WorldCollisionParams, k: int, at: wp.vec3) -> float:
    """Signed distance from a point in an obstacle's frame to its surface [m]; of meshes far away a bound below it."""
    if p.kind[k] == MESH:
        return mesh_distance(p.volumes, p.mesh[k], at)
    return shape_distance(p.kind[k], p.size[k], at)


@wp.func
def least_on_way(p: WorldCollisionParams, k: int, a: wp.vec3, b: wp.vec3, radius: float, least: float) -> float:
    """Least of a bound and the distances of a sphere on its straight way from a to b in an obstacle's frame [m].

    Distances change no faster than the sphere moves. So it is moved on by as much as its distance is above the least
    so far, and by a quarter of its radius at least: nothing is skipped however thin it is, and what is found is at most
    an eighth of the radius above the true minimum.
    """
    length = wp.length(b - a)
    way = float(0.0)
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


@wp.func
def world_collision(s: StepView, p: WorldCollisionParams) -> float:
    """max(0, margin - d), d the least distance of a link's spheres from an obstacle [m]; or 1 if d < margin, else 0.

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
