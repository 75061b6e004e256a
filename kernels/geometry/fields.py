# SPDX-License-Identifier: Apache-2.0
"""Scalar fields over the ground plane: sampled bilinearly, and path lengths to a moving target put together.

Path lengths around obstacles, as cost terms read them.
"""

import warp as wp

from ..cost.view import StepView

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


ATAN_HALF = wp.constant(0.4636476090008061)  # arctan 1/2


@wp.func
def side_of(angle: float) -> float:
    """Fractional index, in [0, 16], of a direction among the 16 of a push value.

    They are those from one grid cell to its neighbours and a knight's move away: 0, arctan 1/2, π/4, arctan 2, π/2 ...
    """
    quarters = angle / wp.half_pi
    turned = quarters - wp.floor(quarters)
    quarter = wp.floor(quarters) - 4.0 * wp.floor(wp.floor(quarters) / 4.0)
    within = turned * wp.half_pi
    mirrored = wp.min(within, wp.half_pi - within)  # in [0, π/4]
    part = mirrored / ATAN_HALF
    if mirrored > ATAN_HALF:
        part = 1.0 + (mirrored - ATAN_HALF) / (0.5 * wp.half_pi - ATAN_HALF)
    return 4.0 * quarter + wp.where(within > mirrored, 4.0 - part, part)


@wp.func
def sample_push(value: wp.array4d[float], e: int, origin: wp.vec2, cell: float, at: wp.vec2, angle: float) -> float:
    """Value [E, rows, columns, 16] of an object at a point with its pusher in a direction, interpolated linearly.

    The values of a cell lie side by side, since terms ask for several directions at one point. Beyond the grid a value
    grows by the distance from it.
    """
    side = side_of(angle)
    low = int(side) % 16
    next = (low + 1) % 16
    part = side - wp.floor(side)
    last = wp.vec2(float(value.shape[2]) - 1.0, float(value.shape[1]) - 1.0)
    x = wp.clamp((at[0] - origin[0]) / cell, 0.0, last[0])
    y = wp.clamp((at[1] - origin[1]) / cell, 0.0, last[1])
    i = wp.min(int(x), value.shape[2] - 2)
    j = wp.min(int(y), value.shape[1] - 2)
    u = x - float(i)
    v = y - float(j)
    first = (1.0 - u) * value[e, j, i, low] + u * value[e, j, i + 1, low]
    second = (1.0 - u) * value[e, j + 1, i, low] + u * value[e, j + 1, i + 1, low]
    here = (1.0 - v) * first + v * second
    first = (1.0 - u) * value[e, j, i, next] + u * value[e, j, i + 1, next]
    second = (1.0 - u) * value[e, j + 1, i, next] + u * value[e, j + 1, i + 1, next]
    there = (1.0 - v) * first + v * second
    inside = wp.min(wp.max(at, origin), origin + cell * last)
    return (1.0 - part) * here + part * there + wp.length(at - inside)


@wp.struct
class GuideTable:
    """Parts of path lengths: waypoints on the borders of grown obstacles, what they see, and how far apart.

    A shortest path that is not straight follows a border for a while, so it passes (nearly) through waypoints. There
    are R requests (a target and a mover's size), each with its own waypoints.
    """

    clearance: wp.array3d[float]  # [1, rows, columns] distance from the obstacles [m]
    inflation: wp.array[float]  # [R] obstacles grow by this [m]
    count: wp.array[int]  # [R] number of waypoints
    sight: wp.array3d[float]  # [R, rows · columns, M] straight way from a cell to a waypoint [m], infinite if blocked
    between: wp.array3d[float]  # [R, M, M] path length between waypoints [m]
    nearest: wp.array3d[int]  # [R, rows, columns] nearest free cell, row · columns + column
    depth: wp.array3d[float]  # [R, rows, columns] distance to it [m]
    origin: wp.vec2  # [m]
    cell: float  # [m]
    body: wp.array[int]  # [R] body of the target, -1 for the world, -2 for the goal
    pose: wp.array[wp.transform]  # [R] target in that body's frame


@wp.func
def clear_way(
    clearance: wp.array3d[float], origin: wp.vec2, cell: float, inflation: float, a: wp.vec2, b: wp.vec2, free: float
) -> bool:
    """Return whether the straight way from a to b clears the grown obstacles, its last ``free`` metres left out."""
    d = wp.length(b - a)
    if d <= free:
        return True
    steps = int((d - free) / cell) + 1
    # in cells; rounded to the nearest one, which may stand half a cell inside
    p = (a - origin) / cell + wp.vec2(0.5, 0.5)
    length = (d - free) / float(steps)
    step = (b - a) * (length / d / cell)
    i = int(0)
    while i < steps:
        q = p + float(i) * step
        room = clearance[0, int(q[1]), int(q[0])] - inflation
        if room < -0.5 * cell:
            return False
        # nothing is nearer than this, so the steps within it need no look; a cell less, for rounding at both ends
        i += 1 + int(wp.max(wp.min(room, d) - cell, 0.0) / length)
    return True


@wp.kernel
def sight_kernel(
    # inputs
    clearance: wp.array3d[float],  # [1, rows, columns] [m]
    inflation: float,  # [m]
    origin: wp.vec2,  # [m]
    cell: float,  # [m]
    point: wp.array[wp.vec2],  # [N] [m]
    waypoint: wp.array[wp.vec2],  # [M] [m]
    # outputs
    sight: wp.array2d[float],  # [N, M] [m]
):
    """One thread: the straight way from a point to a waypoint, infinite where a grown obstacle is in between."""
    i, m = wp.tid()
    sight[i, m] = wp.inf
    # from the border outwards: half of all ways end at once in the obstacle they start at
    if clear_way(clearance, origin, cell, inflation, waypoint[m], point[i], 0.0):
        sight[i, m] = wp.length(point[i] - waypoint[m])


@wp.kernel
def guide_target_kernel(
    # inputs
    table: GuideTable,
    body_q: wp.array2d[wp.transform],  # [E, nb] observed
    task_pose: wp.array2d[wp.transform],  # [E, poses] of the task
    # outputs
    center: wp.array[wp.vec2],  # [E·R] where the target of each field is [m]
    stale: wp.array[int],  # [E·R] whether the field must follow
):
    """One thread: where the target of one field is now; within a cell the old field still tells the way."""
    f = wp.tid()
    requests = table.inflation.shape[0]
    e = f // requests
    r = f % requests
    pose = table.pose[r]
    if table.body[r] < -1:
        pose = task_pose[e, -2 - table.body[r]] * pose
    elif table.body[r] >= 0:
        pose = body_q[e, table.body[r]] * pose
    p = wp.transform_get_translation(pose)
    # beyond the grid there is nothing to go around
    rows = table.clearance.shape[1]
    columns = table.clearance.shape[2]
    at = wp.vec2(
        wp.clamp(p[0], table.origin[0], table.origin[0] + table.cell * float(columns - 1)),
        wp.clamp(p[1], table.origin[1], table.origin[1] + table.cell * float(rows - 1)),
    )
    # written so that a center that was never set (infinite) counts as far
    if wp.length(at - center[f]) <= table.cell:
        stale[f] = 0
    else:
        stale[f] = 1
        center[f] = at


@wp.func
def target_cell(table: GuideTable, at: wp.vec2) -> wp.vec2i:
    """Row and column of the cell nearest to a point."""
    return wp.vec2i(
        int(wp.round((at[1] - table.origin[1]) / table.cell)), int(wp.round((at[0] - table.origin[0]) / table.cell))
    )


@wp.kernel
def guide_waypoint_kernel(
    # inputs
    table: GuideTable,
    center: wp.array[wp.vec2],  # [E·R] [m]
    stale: wp.array[int],  # [E·R]
    # outputs
    remaining: wp.array2d[float],  # [E·R, M] path length from a waypoint to the target [m]
):
    """One thread: the way from one waypoint to one target, by the last waypoint that sees it."""
    f, m = wp.tid()
    r = f % table.inflation.shape[0]
    if stale[f] == 0 or m >= table.count[r]:
        return
    at = target_cell(table, center[f])
    end = table.nearest[r, at[0], at[1]]
    best = float(wp.inf)
    for k in range(table.count[r]):
        best = wp.min(best, table.between[r, m, k] + table.sight[r, end, k])
    remaining[f, m] = best + table.depth[r, at[0], at[1]]


@wp.kernel
def guide_field_kernel(
    # inputs
    table: GuideTable,
    center: wp.array[wp.vec2],  # [E·R]
    stale: wp.array[int],  # [E·R]
    remaining: wp.array2d[float],  # [E·R, M]
    # outputs
    field: wp.array3d[float],  # [E·R, rows, columns] path length to the target [m]
):
    """One thread: the path length from one cell to one target, straight where in sight, else by the best waypoint.

    Around a target inside a grown obstacle the way out is free. Cells inside grown obstacles hold the value of the
    nearest free cell plus twice the way there, so that the field leads out of them. Where there is no way at all it is
    twice the straight one.
    """
    f, row, column = wp.tid()
    if stale[f] == 0:
        return
    r = f % table.inflation.shape[0]
    columns = table.clearance.shape[2]
    inflation = table.inflation[r]
    target = center[f]
    start = table.nearest[r, row, column]
    here = table.origin + table.cell * wp.vec2(float(start % columns), float(start // columns))
    clear = sample_field(table.clearance, 0, table.origin, table.cell, target)
    free = wp.max(inflation - clear + 1.5 * table.cell, 2.0 * table.cell)
    itself = table.origin + table.cell * wp.vec2(float(column), float(row))
    if wp.length(target - itself) <= free:
        field[f, row, column] = wp.length(target - itself)
        return
    straight = wp.length(target - here)
    length = float(straight)
    if not clear_way(table.clearance, table.origin, table.cell, inflation, here, target, free):
        best = float(wp.inf)
        for m in range(table.count[r]):
            best = wp.min(best, table.sight[r, start, m] + remaining[f, m])
        length = wp.where(wp.isfinite(best), wp.max(best, straight), 2.0 * straight)
    field[f, row, column] = length + 2.0 * table.depth[r, row, column]


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
