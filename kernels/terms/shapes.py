# SPDX-License-Identifier: Apache-2.0
"""Signed distances from primitive shapes."""

import warp as wp

wp.set_module_options({"enable_backward": False})

SPHERE = wp.constant(0)
BOX = wp.constant(1)
CYLINDER = wp.constant(2)
CAPSULE = wp.constant(3)
PLANE = wp.constant(4)
MESH = wp.constant(5)
"""Kind of a shape whose distance a volume tells."""


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
