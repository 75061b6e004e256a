# SPDX-License-Identifier: Apache-2.0
"""Cost terms about distances from shapes and their outlines."""

import warp as wp

from .view import (
    StepView,
    frame_pose,
    frame_position,
    yaw,
)

wp.set_module_options({"enable_backward": False})

SPHERE = wp.constant(0)
BOX = wp.constant(1)
CYLINDER = wp.constant(2)
CAPSULE = wp.constant(3)
PLANE = wp.constant(4)


@wp.func
def shape_distance(kind: int, size: wp.vec3, p: wp.vec3) -> float:
    """Signed distance from a point in a shape's frame to its surface [m]; sizes are half extents or radius, half."""
    if kind == SPHERE:
        return wp.length(p) - size[0]
    if kind == CAPSULE:
        return wp.length(p - wp.vec3(0.0, 0.0, wp.clamp(p[2], -size[1], size[1]))) - size[0]
    if kind == PLANE:
        return p[2]
    q = wp.vec3(wp.abs(p[0]) - size[0], wp.abs(p[1]) - size[1], wp.abs(p[2]) - size[2])
    if kind == CYLINDER:
        q = wp.vec3(wp.length(wp.vec2(p[0], p[1])) - size[0], wp.abs(p[2]) - size[1], -wp.inf)
    outside = wp.length(wp.vec3(wp.max(q[0], 0.0), wp.max(q[1], 0.0), wp.max(q[2], 0.0)))
    return outside + wp.min(wp.max(q[0], wp.max(q[1], q[2])), 0.0)


@wp.struct
class ObstacleClearanceParams:
    """Parameters of ``obstacle_clearance``."""

    of: int
    pose: wp.array[wp.transform]  # world → obstacle
    kind: wp.array[int]
    size: wp.array[wp.vec3]
    surface: int  # measure to the surface instead of the centre
    radius: float  # [m] of the robot about the frame, subtracted from the distance
    least: float  # [m] shorter distances count as this


@wp.func
def obstacle_clearance(s: StepView, p: ObstacleClearanceParams) -> float:
    """Σ 1/d over the obstacles [1/m]."""
    position = frame_position(s, p.of)
    total = float(0.0)
    for i in range(p.pose.shape[0]):
        local = wp.transform_point(p.pose[i], position)
        d = wp.length(local)
        if p.surface != 0:
            d = shape_distance(p.kind[i], p.size[i], local)
        total += 1.0 / wp.max(d - p.radius, p.least)
    return total


@wp.func
def apart_of(
    corner: wp.array[wp.vec2], first: int, count: int, other: int, others: int, turn: wp.mat22, shift: wp.vec2
) -> wp.vec2:
    """Distance of another outline's corners from a convex counter-clockwise outline [m].

    The other's corners are turned and shifted into this one's frame. Returns the least distance from an edge, and the
    greatest over the edges of the least distance outwards: that one is negative for all edges of both outlines if and
    only if they overlap (separating axes).
    """
    nearest = float(wp.inf)
    gap = float(-wp.inf)
    for i in range(count):
        a = corner[first + i]
        edge = corner[first + (i + 1) % count] - a
        size = wp.length(edge)
        outwards = float(wp.inf)
        for k in range(others):
            off = turn * corner[other + k] + shift - a
            along = wp.clamp(wp.dot(off, edge) / (size * size), 0.0, 1.0)
            nearest = wp.min(nearest, wp.length(off - along * edge))
            outwards = wp.min(outwards, (off[0] * edge[1] - off[1] * edge[0]) / size)
        gap = wp.max(gap, outwards)
    return wp.vec2(nearest, gap)


@wp.struct
class OutlineClearanceParams:
    """Parameters of ``outline_clearance``: outlines seen from above, the body's in its frame, then the obstacles'."""

    of: int
    corner: wp.array[wp.vec2]  # [corners] [m]
    first: wp.array[int]  # [outline] first corner
    count: wp.array[int]  # [outline] number of corners
    centre: wp.array[wp.vec2]  # [outline] of a circle around it [m]
    radius: wp.array[float]  # [outline] [m]
    within: float  # [m] greater distances cost nothing


@wp.func
def outline_clearance(s: StepView, p: OutlineClearanceParams) -> float:
    """Σ max(0, 1 - d/within) over the obstacles, with d between their outlines and a body's, seen from above.

    The distance between two convex outlines that do not overlap is one from a corner of either to the other; of those
    that do it is the depth, negative.
    """
    pose = frame_pose(s, p.of)
    c = wp.cos(yaw(wp.transform_get_rotation(pose)))
    d = wp.sin(yaw(wp.transform_get_rotation(pose)))
    position = wp.transform_get_translation(pose)
    at = wp.vec2(position[0], position[1])
    turn = wp.mat22(c, -d, d, c)
    total = float(0.0)
    centre = at + turn * p.centre[0]
    for k in range(1, p.first.shape[0]):
        if wp.length(centre - p.centre[k]) - p.radius[0] - p.radius[k] >= p.within:
            continue
        back = wp.transpose(turn)
        a = apart_of(p.corner, p.first[k], p.count[k], 0, p.count[0], turn, at)
        b = apart_of(p.corner, 0, p.count[0], p.first[k], p.count[k], back, -(back * at))
        gap = wp.max(a[1], b[1])
        least = wp.min(wp.where(gap < 0.0, gap, wp.min(a[0], b[0])), p.within)
        total += 1.0 - least / p.within
    return total


@wp.struct
class OutlineDistanceParams:
    """Parameters of ``outline_distance``."""

    of: int
    object: int
    pose: wp.transform  # object → shape
    kind: int
    size: wp.vec3
    inside: float  # factor on the depth within the outline


@wp.func
def outline_distance(s: StepView, p: OutlineDistanceParams) -> float:
    """Distance from a frame to the outline of an object that stands upright, seen from above [m].

    ‖p_R - p_O‖ (Pezzato et al. 2025, Eq. 10) is least on top of the object; this is least at its sides.
    """
    local = wp.transform_point(wp.transform_inverse(frame_pose(s, p.object)), frame_position(s, p.of))
    at = wp.transform_point(p.pose, local)
    d = shape_distance(p.kind, p.size, wp.vec3(at[0], at[1], 0.0))
    return wp.where(d < 0.0, -p.inside * d, d)
