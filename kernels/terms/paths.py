# SPDX-License-Identifier: Apache-2.0
"""Path lengths around obstacles, as cost terms read them."""

import warp as wp

from ..geometry.fields import field_gradient, sample_field
from .view import StepView

wp.set_module_options({"enable_backward": False})


@wp.struct
class PathFields:
    """Distance fields over the ground plane, R per environment."""

    length: wp.array3d[float]  # [E·R, rows, columns] path length to the field's target [m]
    center: wp.array[wp.vec2]  # [E·R] where that target was when the plan started [m]
    origin: wp.vec2  # place of the first cell [m]
    cell: float  # [m]
    count: int  # R


@wp.func
def plane_distance(s: StepView, paths: PathFields, field: int, target: wp.vec2, p: wp.vec2) -> float:
    """Distance in the ground plane, straight (``field`` -1) or along the shortest path around the obstacles [m].

    The field holds the path length to where the target was when the plan started. What it exceeds the straight
    line by is the detour at p; the target may move during the horizon, so the detour is added to the straight
    distance to where it is now.
    """
    straight = wp.length(p - target)
    if field < 0:
        return straight
    f = s.e * paths.count + field
    path = sample_field(paths.length, f, paths.origin, paths.cell, p)
    # between cells the field is interpolated, which adds a little near the target
    return straight + wp.max(path - wp.length(p - paths.center[f]) - 0.25 * paths.cell, 0.0)


@wp.func
def way_out(s: StepView, paths: PathFields, field: int, at: wp.vec2, straight: wp.vec2) -> wp.vec2:
    """Direction in which the way to a target leaves a point: ``straight``, or down the field where that is a detour."""
    if field >= 0:
        f = s.e * paths.count + field
        path = sample_field(paths.length, f, paths.origin, paths.cell, at)
        if path - wp.length(at - paths.center[f]) > paths.cell:
            return -field_gradient(paths.length, f, paths.origin, paths.cell, at)
    return straight
