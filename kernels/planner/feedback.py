# SPDX-License-Identifier: Apache-2.0
"""Rollouts under a feedback policy, step by step: controls from states, and what a step costs."""

import warp as wp

from ..cost.norms import Norm, norm_part, norm_total
from .costs import CostWeights, risk_ratio, stage_weight

wp.set_module_options({"enable_backward": False})

PLAIN = wp.constant(0)
TURN = wp.constant(1)


@wp.struct
class TangentTable:
    """Relation of the numbers of a MuJoCo state to those of its tangent space."""

    kind: wp.array[int]  # [m] PLAIN, or TURN of a quaternion (w, x, y, z)
    state: wp.array[int]  # [m] first number in the state
    tangent: wp.array[int]  # [m] first number in the tangent space


@wp.func
def rotation_between(
    state: wp.array3d[wp.float64], w: int, n: int, i: int, other: wp.array3d[wp.float64], e: int, t: int, j: int
) -> wp.vec3d:
    """Rotation vector from other[e, t, j:] to state[w, n, i:], both quaternions (w, x, y, z), in the former's frame."""
    a = wp.vec3d(-other[e, t, j + 1], -other[e, t, j + 2], -other[e, t, j + 3])
    b = wp.vec3d(state[w, n, i + 1], state[w, n, i + 2], state[w, n, i + 3])
    a0 = other[e, t, j]
    b0 = state[w, n, i]
    scalar = a0 * b0 - wp.dot(a, b)
    vector = a0 * b + b0 * a + wp.cross(a, b)
    if scalar < wp.float64(0.0):
        scalar = -scalar
        vector = -vector
    size = wp.length(vector)
    if size < wp.float64(1.0e-12):
        return wp.float64(2.0) * vector
    return wp.float64(2.0) * wp.atan2(size, scalar) / size * vector


@wp.kernel
def follow_kernel(
    # inputs
    t: int,  # step
    first: int,  # world of thread 0
    rollouts: int,  # worlds of an environment
    hold: int,  # steps that a control is held for
    policies: int,  # policies of an environment, P
    policy: wp.array[int],  # [N] which of them each world of an environment follows
    noise: wp.array3d[wp.float64],  # [W, T, nu] ε
    table: TangentTable,
    end: wp.array3d[wp.float64],  # [W, N, 1+nx] the last slice is the state after the step before
    nominal: wp.array3d[wp.float64],  # [E·P, T, nx]
    control: wp.array3d[wp.float64],  # [E·P, T, nu] of the nominal rollout
    change: wp.array3d[wp.float64],  # [E·P, T, nu] k
    gain: wp.array4d[wp.float64],  # [E·P, T, nu, n] K
    share: wp.array[wp.float64],  # [N] α of each world of an environment
    feedback: wp.array[wp.float64],  # [N] how much of K each has
    lower: wp.array[wp.float64],  # [nu]
    upper: wp.array[wp.float64],  # [nu]
    # inputs and outputs
    start: wp.array2d[wp.float64],  # [W, 1+nx] read at the first step
    difference: wp.array2d[wp.float64],  # [W, n] scratch
    # outputs
    states: wp.array3d[wp.float64],  # [T+1, W, nx] states that were met
    controls: wp.array3d[wp.float64],  # [T, W, nu] controls that were taken
    applied: wp.array3d[float],  # [2, W, nu] the control before and this one
):
    """One thread: one world's control u = ū + αk + K (x ⊖ x̄) + ε at a step, within its limits, and its start."""
    w = first + wp.tid()
    i = w % rollouts
    e = policies * (w // rollouts) + policy[i]
    width = states.shape[2]
    steps = controls.shape[0]
    last = end.shape[1] - 1
    if t > 0:
        for j in range(width):
            start[w, 1 + j] = end[w, last, 1 + j]
    for j in range(width):
        states[t, w, j] = start[w, 1 + j]
    if t == steps:
        return
    if t % hold != 0:
        for u in range(controls.shape[2]):
            controls[t, w, u] = controls[t - 1, w, u]
            applied[0, w, u] = applied[1, w, u]
        return
    for m in range(table.kind.shape[0]):
        at = table.state[m]
        to = table.tangent[m]
        if table.kind[m] == TURN:
            turn = rotation_between(states, t, w, at, nominal, e, t, at)
            for k in range(3):
                difference[w, to + k] = turn[k]
        else:
            difference[w, to] = states[t, w, at] - nominal[e, t, at]
    for u in range(controls.shape[2]):
        correction = wp.float64(0.0)
        for j in range(difference.shape[1]):
            correction += gain[e, t, u, j] * difference[w, j]
        x = control[e, t, u] + share[i] * change[e, t, u] + feedback[i] * correction + noise[w, t, u]
        # engines take controls in single precision
        single = float(wp.clamp(x, lower[u], upper[u]))
        controls[t, w, u] = wp.float64(single)
        applied[0, w, u] = applied[1, w, u]
        applied[1, w, u] = single


@wp.kernel
def add_cost_kernel(
    # inputs
    t: int,  # step
    first: int,  # world of thread 0
    rollouts: int,  # worlds of an environment
    residual: wp.array2d[float],  # [W, R]
    begin: wp.array[int],  # [term] first of each term's residuals
    count: wp.array[int],  # [term] how many they are
    kind: wp.array[int],  # [term] norm
    p: wp.array[float],  # [term]
    q: wp.array[float],  # [term]
    weights: CostWeights,
    risk: float,  # R of ρ(l; R)
    diverged: wp.array[int],  # [W]
    # inputs and outputs
    cost: wp.array[wp.float64],  # [W]
):
    """One thread: what one step of one world costs, added to its rollout's cost; infinite once its physics failed."""
    w = first + wp.tid()
    e = w // rollouts
    if t == 0:
        cost[w] = wp.float64(0.0)
    total = float(0.0)
    for i in range(count.shape[0]):
        factor = stage_weight(weights, e, t, i)
        if factor != 0.0:
            norm = Norm()
            norm.kind = kind[i]
            norm.p = p[i]
            norm.q = q[i]
            parts = float(0.0)
            for j in range(count[i]):
                parts += norm_part(residual[w, begin[i] + j], norm)
            total += factor * norm_total(parts, norm)
    value = wp.float64(weights.discount[t] * total * risk_ratio(risk * total))
    if diverged[w] != 0 or not wp.isfinite(value):
        value = wp.float64(wp.inf)
    cost[w] = cost[w] + value
