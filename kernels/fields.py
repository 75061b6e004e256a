# SPDX-License-Identifier: Apache-2.0
"""Scalar fields over the ground plane: sampled bilinearly, and path lengths to a moving target put together."""

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


@wp.struct
class GuideTable:
    """What path lengths are made of: the way from every cell to waypoints on the borders of grown obstacles.

    A shortest path that is not straight touches a border, so it passes (nearly) through a waypoint. The fields of R
    requests (a target and a mover's size) stand one after the other.
    """

    clearance: wp.array3d[float]  # [1, rows, columns] distance from the obstacles [m]
    inflation: wp.array[float]  # [R] obstacles grow by this [m]
    waypoint_start: wp.array[int]  # [R+1] first waypoint of each request
    waypoint: wp.array2d[float]  # [rows · columns, M] path length to each waypoint [m]
    nearest: wp.array3d[int]  # [R, rows, columns] nearest free cell, row · columns + column
    depth: wp.array3d[float]  # [R, rows, columns] distance to it [m]
    origin: wp.vec2  # [m]
    cell: float  # [m]
    body: wp.array[int]  # [R] body of the target, negative for one that stays
    pose: wp.array[wp.transform]  # [R] target in that body's frame


@wp.kernel
def guide_target_kernel(
    # inputs
    table: GuideTable,
    body_q: wp.array3d[wp.transform],  # [T+1, W, nb] slice 0 is read
    rollouts: int,  # worlds per environment
    # outputs
    center: wp.array[wp.vec2],  # [E·R] where the target of each field is [m]
    stale: wp.array[int],  # [E·R] whether the field must follow
):
    """One thread: where the moving target of one field is; within half a cell the old field still tells the way."""
    f = wp.tid()
    requests = table.inflation.shape[0]
    e = f // requests
    r = f % requests
    if table.body[r] < 0:
        stale[f] = 0
        return
    p = wp.transform_get_translation(body_q[0, e * rollouts, table.body[r]] * table.pose[r])
    # beyond the grid there is nothing to go around
    rows = table.clearance.shape[1]
    columns = table.clearance.shape[2]
    at = wp.vec2(
        wp.clamp(p[0], table.origin[0], table.origin[0] + table.cell * float(columns - 1)),
        wp.clamp(p[1], table.origin[1], table.origin[1] + table.cell * float(rows - 1)),
    )
    # written so that a center that was never set (infinite) counts as far
    if wp.length(at - center[f]) <= 0.5 * table.cell:
        stale[f] = 0
    else:
        stale[f] = 1
        center[f] = at


@wp.func
def in_sight(table: GuideTable, r: int, a: wp.vec2, b: wp.vec2) -> bool:
    """Whether the straight way from a to the target b keeps clear of the grown obstacles.

    Around a target inside a grown obstacle the way out is free.
    """
    d = wp.length(b - a)
    blocked = table.inflation[r]
    clear = sample_field(table.clearance, 0, table.origin, table.cell, b)
    free = wp.max(blocked - clear + 1.5 * table.cell, 2.0 * table.cell)
    if d <= free:
        return True
    steps = int((d - free) / table.cell) + 1
    # in cells; rounded to the nearest one, which may stand half a cell inside
    p = (a - table.origin) / table.cell + wp.vec2(0.5, 0.5)
    step = (b - a) * ((d - free) / d / float(steps) / table.cell)
    for _ in range(steps):
        if table.clearance[0, int(p[1]), int(p[0])] < blocked - 0.5 * table.cell:
            return False
        p += step
    return True


@wp.kernel
def guide_field_kernel(
    # inputs
    table: GuideTable,
    center: wp.array[wp.vec2],  # [E·R]
    stale: wp.array[int],  # [E·R]
    # outputs
    field: wp.array3d[float],  # [E·R, rows, columns] path length to the target [m]
):
    """One thread: the path length from one cell to one target, straight where in sight, else by the best waypoint.

    Cells inside grown obstacles hold the value of the nearest free cell plus twice the way there, so that the field
    leads out of them.
    """
    f, row, column = wp.tid()
    if stale[f] == 0:
        return
    r = f % table.inflation.shape[0]
    columns = table.clearance.shape[2]
    target = center[f]
    start = table.nearest[r, row, column]
    here = table.origin + table.cell * wp.vec2(float(start % columns), float(start // columns))
    length = wp.length(target - here)
    if not in_sight(table, r, here, target):
        target_row = int(wp.round((target[1] - table.origin[1]) / table.cell))
        target_column = int(wp.round((target[0] - table.origin[0]) / table.cell))
        end = table.nearest[r, target_row, target_column]
        rest = table.depth[r, target_row, target_column]
        best = float(wp.inf)
        for m in range(table.waypoint_start[r], table.waypoint_start[r + 1]):
            best = wp.min(best, table.waypoint[start, m] + table.waypoint[end, m])
        length = wp.max(length, best + rest)
    field[f, row, column] = length + 2.0 * table.depth[r, row, column]
