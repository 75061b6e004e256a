# SPDX-License-Identifier: Apache-2.0
"""Terms about distances from shapes and their outlines."""

from typing import Any, Literal

import numpy as np
import warp as wp

from ...kernels.cost.points import shape_distance
from ...kernels.cost.view import StepView, frame_pose, frame_position, yaw
from ...scene.types import NonNegative, Positive
from ..binding import PRIMITIVES, Binding
from ..keys import Frame, Object, TermKeys, term
from ..resources.geodesic import convex_outline, obstacle_outlines, outline


class ObstacleClearance(TermKeys):
    """Σ 1/d over the obstacles."""

    of: Frame
    """Frame."""
    to: Literal["surface", "centre"] = "surface"
    """surface or centre of the obstacles."""
    radius: NonNegative = 0.0
    """Subtracted from the distance [m]."""
    least: Positive = 0.05
    """Shorter distances count as this [m]."""

    derived = {"pose": wp.array[wp.transform], "kind": wp.array[int], "size": wp.array[wp.vec3], "surface": int}

    def bind(self, p: Any, b: Binding) -> None:
        """Find the obstacles' shapes and the poses of the world in their frames."""
        b.require_still()
        shapes = [b.layout.shapes[i] for e in b.layout.group("obstacles") for i in e.shapes]
        if meshes := [s.name for s in shapes if s.kind not in PRIMITIVES]:
            raise b.error("clearance needs primitive obstacles", found=meshes[0])
        p.surface = int(self.to == "surface")
        p.pose = b.array([wp.transform_inverse(wp.transform(*s.pose)) for s in shapes], dtype=wp.transform)
        p.kind = b.array([PRIMITIVES[s.kind] for s in shapes], dtype=int)
        p.size = b.array([s.scale for s in shapes], dtype=wp.vec3)


@term("obstacle_clearance", ObstacleClearance)
def obstacle_clearance(s: StepView, p: ObstacleClearance.Params) -> float:
    """Nearness to obstacles, Σ 1/d [1/m]."""
    position = frame_position(s, p.of)
    total = wp.float32(0.0)
    for i in range(p.pose.shape[0]):
        local = wp.transform_point(p.pose[i], position)
        d = wp.length(local)
        if p.surface != 0:
            d = shape_distance(p.kind[i], p.size[i], local)
        total += 1.0 / wp.max(d - p.radius, p.least)
    return total


class OutlineClearance(TermKeys):
    """Nearness of a body's outline to the obstacles', seen from above: Σ max(0, 1 - d/within)."""

    of: Frame
    """Frame of the body, upright; its link's colliding shapes are its outline (their convex hull)."""
    within: Positive
    """Distances from here on cost nothing [m]."""

    derived = {
        "corner": wp.array[wp.vec2],  # [corners] of the body's outline in its frame, then of the obstacles' [m]
        "first": wp.array[int],  # [outline] first corner
        "count": wp.array[int],  # [outline] number of corners
        "centre": wp.array[wp.vec2],  # [outline] of a circle around it [m]
        "radius": wp.array[float],  # [outline] [m]
    }

    def bind(self, p: Any, b: Binding) -> None:
        """Find the outlines, seen from above."""
        b.require_still()
        layout = b.layout
        body = int(layout.frame_body[p.of])
        own = [s for s in layout.shapes if s.body == body and s.collides and s.kind != "plane"]
        if body < 0 or not own:
            raise b.error("this frame's body has no colliding shape", "of", found=self.of)
        to_frame = wp.transform_inverse(wp.transform(*layout.frame_pose[p.of]))
        lying = {e.name for e in layout.group("objects")}
        supports = b.supports if self.of.split("/")[0] in lying else ()
        outlines = [convex_outline(np.concatenate([outline(layout, s, to_frame) for s in own]))]
        outlines += [corners for _, corners in obstacle_outlines(layout, supports)]
        counts = [len(o) for o in outlines]
        centres = [o.mean(axis=0) for o in outlines]
        p.corner = b.array(np.concatenate(outlines), dtype=wp.vec2)
        p.first = b.array(np.cumsum([0, *counts[:-1]]), dtype=int)
        p.count = b.array(counts, dtype=int)
        p.centre = b.array(centres, dtype=wp.vec2)
        radii = [np.linalg.norm(o - c, axis=1).max() for o, c in zip(outlines, centres, strict=True)]
        p.radius = b.array(radii, dtype=float)


@wp.func
def apart_of(
    corner: wp.array[wp.vec2], first: int, count: int, other: int, others: int, turn: wp.mat22, shift: wp.vec2
) -> wp.vec2:
    """Distance of another outline's corners from a convex counter-clockwise outline [m].

    The other's corners are turned and shifted into this one's frame. Returns the least distance from an edge, and the
    greatest over the edges of the least distance outwards: that one is negative for all edges of both outlines if and
    only if they overlap (separating axes).
    """
    nearest = wp.float32(wp.inf)
    gap = wp.float32(-wp.inf)
    for i in range(count):
        a = corner[first + i]
        edge = corner[first + (i + 1) % count] - a
        size = wp.length(edge)
        outwards = wp.float32(wp.inf)
        for k in range(others):
            off = turn * corner[other + k] + shift - a
            along = wp.clamp(wp.dot(off, edge) / (size * size), 0.0, 1.0)
            nearest = wp.min(nearest, wp.length(off - along * edge))
            outwards = wp.min(outwards, (off[0] * edge[1] - off[1] * edge[0]) / size)
        gap = wp.max(gap, outwards)
    return wp.vec2(nearest, gap)


@term("outline_clearance", OutlineClearance)
def outline_clearance(s: StepView, p: OutlineClearance.Params) -> float:
    """Nearness to obstacles seen from above, Σ max(0, 1 - d/within), d between the outlines of a body and each.

    The distance between two convex outlines that do not overlap is one from a corner of either to the other; of those
    that do it is the depth, negative.
    """
    pose = frame_pose(s, p.of)
    c = wp.cos(yaw(wp.transform_get_rotation(pose)))
    d = wp.sin(yaw(wp.transform_get_rotation(pose)))
    position = wp.transform_get_translation(pose)
    at = wp.vec2(position[0], position[1])
    turn = wp.mat22(c, -d, d, c)
    total = wp.float32(0.0)
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


class OutlineDistance(TermKeys):
    """Distance to the outline of an object seen from above [m]: least at its sides, not on top of it."""

    of: Frame
    """Frame."""
    object: Object
    """Upright object with a primitive shape."""
    inside: NonNegative = 1.0
    """Factor on the depth within the outline: keeps a pusher from climbing onto the object."""

    derived = {"pose": wp.transform, "kind": int, "size": wp.vec3}

    def bind(self, p: Any, b: Binding) -> None:
        """Find the shape and the pose of the object in its frame."""
        shape = b.object_shape(self.object, "object")
        p.pose = wp.transform_inverse(wp.transform(*shape.pose))
        x, y, _ = shape.scale
        # as tall as needed: the nearest point of the shape then lies level with the frame
        p.kind, p.size = (PRIMITIVES["box"], wp.vec3(x, y, 1e3)) if shape.kind == "box" else (2, wp.vec3(x, 1e3, 0.0))


@term("outline_distance", OutlineDistance)
def outline_distance(s: StepView, p: OutlineDistance.Params) -> float:
    """Distance from a frame to the outline of an object that stands upright, seen from above [m].

    ‖p_R - p_O‖ (Pezzato et al. 2025, Eq. 10) is least on top of the object; this is least at its sides.
    """
    local = wp.transform_point(wp.transform_inverse(frame_pose(s, p.object)), frame_position(s, p.of))
    at = wp.transform_point(p.pose, local)
    d = shape_distance(p.kind, p.size, wp.vec3(at[0], at[1], 0.0))
    return wp.where(d < 0.0, -p.inside * d, d)
