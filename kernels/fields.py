# SPDX-License-Identifier: Apache-2.0
"""Scalar fields over the ground plane, sampled bilinearly."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def sample_field(field: wp.array3d[float], f: int, origin: wp.vec2, cell: float, p: wp.vec2) -> float:
    """Bilinear value of field f at a point [m], clamped to the grid's border."""
    rows = field.shape[1]
    columns = field.shape[2]
    x = wp.clamp((p[0] - origin[0]) / cell, 0.0, float(columns) - 1.0)
    y = wp.clamp((p[1] - origin[1]) / cell, 0.0, float(rows) - 1.0)
    i = wp.min(int(x), columns - 2)
    j = wp.min(int(y), rows - 2)
    u = x - float(i)
    v = y - float(j)
    low = (1.0 - u) * field[f, j, i] + u * field[f, j, i + 1]
    high = (1.0 - u) * field[f, j + 1, i] + u * field[f, j + 1, i + 1]
    return (1.0 - v) * low + v * high


@wp.func
def field_gradient(field: wp.array3d[float], f: int, origin: wp.vec2, cell: float, p: wp.vec2) -> wp.vec2:
    """Gradient of field f at a point, by central differences over one cell each way."""
    dx = sample_field(field, f, origin, cell, p + wp.vec2(cell, 0.0)) - sample_field(
        field, f, origin, cell, p - wp.vec2(cell, 0.0)
    )
    dy = sample_field(field, f, origin, cell, p + wp.vec2(0.0, cell)) - sample_field(
        field, f, origin, cell, p - wp.vec2(0.0, cell)
    )
    return wp.vec2(dx, dy) / (2.0 * cell)
