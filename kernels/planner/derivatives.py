# SPDX-License-Identifier: Apache-2.0
"""Centred differences of control steps, and derivatives of norms, for many steps at once."""

import warp as wp

from ..cost.norms import Norm, norm_bend, norm_part, norm_slope, norm_total
from .feedback import TURN, TangentTable, rotation_between

wp.set_module_options({"enable_backward": False})

STRAIGHT = wp.constant(-1)


@wp.struct
class Moves:
    """Displacements of states and controls, one coordinate at a time; n of the states' tangent space."""

    place: wp.array[int]  # [n] number of the state, the first of a quaternion (w, x, y, z)
    axis: wp.array[int]  # [n] STRAIGHT, or the axis that it is turned about
    state: wp.array[wp.float64]  # [n] how far [rad, m, rad/s or m/s]
    control: wp.array[wp.float64]  # [nu] how far, before limits
    lower: wp.array[wp.float64]  # [nu]
    upper: wp.array[wp.float64]  # [nu]


@wp.kernel
def move_kernel(
    # inputs
    first: int,  # world of thread 0
    moves: Moves,
    state: wp.array3d[wp.float64],  # [E, T, nx] states before the steps
    control: wp.array3d[wp.float64],  # [E, T, nu]
    before: wp.array2d[wp.float64],  # [E, nu] controls that acted before the first step
    # outputs
    start: wp.array2d[wp.float64],  # [W, 1+nx] W = E·T·(1+2(n+nu)): unmoved, n forth, n back, nu forth, nu back
    applied: wp.array3d[float],  # [2, W, nu] the control before and this one
):
    """One thread: the state and controls that one world's step begins with."""
    w = first + wp.tid()
    n = moves.place.shape[0]
    nu = control.shape[2]
    each = 1 + 2 * (n + nu)
    k = w % each
    t = (w // each) % state.shape[1]
    e = w // (each * state.shape[1])
    for i in range(state.shape[2]):
        start[w, 1 + i] = state[e, t, i]
    for u in range(nu):
        if t == 0:
            applied[0, w, u] = float(before[e, u])
        else:
            applied[0, w, u] = float(control[e, t - 1, u])
        applied[1, w, u] = float(control[e, t, u])
    if k == 0:
        return
    if k <= 2 * n:
        c = (k - 1) % n
        step = wp.where(k <= n, moves.state[c], -moves.state[c])
        at = 1 + moves.place[c]
        if moves.axis[c] == STRAIGHT:
            start[w, at] = start[w, at] + step
        else:
            turn_about(start, w, at, moves.axis[c], step)
        return
    u = (k - 1 - 2 * n) % nu
    # at a limit the difference is taken on its inside; engines take controls in single precision
    if k <= 2 * n + nu:
        applied[1, w, u] = float(wp.min(control[e, t, u] + moves.control[u], moves.upper[u]))
    else:
        applied[1, w, u] = float(wp.max(control[e, t, u] - moves.control[u], moves.lower[u]))


@wp.func
def turn_about(start: wp.array2d[wp.float64], w: int, at: int, axis: int, angle: wp.float64):
    """Turn the quaternion (w, x, y, z) start[w, at:] about an axis of its own frame, and make it one again."""
    half = wp.float64(0.5) * angle
    v = wp.vec3d(start[w, at + 1], start[w, at + 2], start[w, at + 3])
    u = wp.vec3d()
    u[axis] = wp.sin(half)
    scalar = start[w, at] * wp.cos(half) - wp.dot(v, u)
    vector = start[w, at] * u + wp.cos(half) * v + wp.cross(v, u)
    size = wp.sqrt(scalar * scalar + wp.dot(vector, vector))
    start[w, at] = scalar / size
    for i in range(3):
        start[w, at + 1 + i] = vector[i] / size


@wp.kernel
def difference_kernel(
    # inputs
    first: int,  # row of thread 0
    table: TangentTable,
    moves: Moves,
    end: wp.array3d[wp.float64],  # [W, N, 1+nx] the last slice is the state after the step
    residual: wp.array2d[float],  # [W, R] after the step
    diverged: wp.array[int],  # [W]
    applied: wp.array3d[float],  # [2, W, nu] the control before and this one
    # outputs
    out: wp.array3d[wp.float64],  # [E·T, 1+n+nu, n+R]
):
    """One thread: the residuals of one step that is not moved, or derivatives of its end and residuals in one number.

    Not finite where the physics failed.
    """
    i = first + wp.tid()
    n = moves.place.shape[0]
    nu = applied.shape[2]
    row = i % (1 + n + nu)
    step = i // (1 + n + nu)
    still = step * (1 + 2 * (n + nu))
    if row == 0:
        for r in range(residual.shape[1]):
            out[step, 0, n + r] = wp.where(diverged[still] != 0, wp.float64(wp.inf), wp.float64(residual[still, r]))
        return
    forth = still + row
    back = forth + n
    if row > n:
        forth = forth + n
        back = forth + nu
    wide = wp.float64(0.0)
    if row <= n:
        wide = wp.float64(2.0) * moves.state[row - 1]
    else:
        wide = wp.float64(applied[1, forth, row - 1 - n]) - wp.float64(applied[1, back, row - 1 - n])
    if diverged[forth] != 0 or diverged[back] != 0:
        wide = wp.float64(0.0)
    last = end.shape[1] - 1
    for m in range(table.kind.shape[0]):
        at = 1 + table.state[m]
        to = table.tangent[m]
        if table.kind[m] == TURN:
            turn = rotation_between(end, forth, last, at, end, back, last, at)
            for k in range(3):
                out[step, row, to + k] = turn[k] / wide
        else:
            out[step, row, to] = (end[forth, last, at] - end[back, last, at]) / wide
    for r in range(residual.shape[1]):
        out[step, row, n + r] = wp.float64(residual[forth, r] - residual[back, r]) / wide


@wp.kernel
def norms_kernel(
    # inputs
    residual: wp.array2d[float],  # [N, R] residuals of all terms, side by side
    first: wp.array[int],  # [term] first of each term's numbers
    count: wp.array[int],  # [term] how many they are
    kind: wp.array[int],  # [term] norm
    p: wp.array[float],  # [term]
    q: wp.array[float],  # [term]
    # outputs
    value: wp.array2d[float],  # [N, term] norm of each term
    slope: wp.array2d[float],  # [N, R] its gradient
    bend: wp.array3d[float],  # [N, R, widest] row i of the Hessian of number i's own term
):
    """One thread: the norm of one term's residual at one step, with its gradient and Hessian."""
    n, i = wp.tid()
    norm = Norm()
    norm.kind = kind[i]
    norm.p = p[i]
    norm.q = q[i]
    start = first[i]
    total = float(0.0)
    for j in range(count[i]):
        total += norm_part(residual[n, start + j], norm)
    value[n, i] = norm_total(total, norm)
    for j in range(count[i]):
        x = residual[n, start + j]
        slope[n, start + j] = norm_slope(x, total, norm)
        for k in range(count[i]):
            bend[n, start + j, k] = norm_bend(x, residual[n, start + k], wp.where(j == k, 1, 0), total, norm)
