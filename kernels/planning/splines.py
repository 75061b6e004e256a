# SPDX-License-Identifier: Apache-2.0
"""Splines over uniform knots: knots to controls, the plan re-sampled later, the command of this moment.

Time τ is measured in knot intervals: knot j stands at τ = j, and outside [0, P-1] the end value is held.
"""

import warp as wp

ZERO = wp.constant(0)
LINEAR = wp.constant(1)
CUBIC = wp.constant(2)
BSPLINE = wp.constant(3)

# a knot counts as reached this much early: t·control_dt/knot_dt may round to just below a whole number
KNOT_TOLERANCE = wp.constant(1.0e-4)


@wp.func
def knot_slope(knots: wp.array2d[float], j: int, u: int) -> float:
    """Slope at knot j per knot interval: central difference, one-sided at the ends (Howell et al. 2022, Eq. 23)."""
    last = knots.shape[0] - 1
    before = wp.max(j - 1, 0)
    after = wp.min(j + 1, last)
    return (knots[after, u] - knots[before, u]) / wp.max(float(after - before), 1.0)


@wp.func
def control_point(knots: wp.array2d[float], j: int, u: int) -> float:
    """Control point j of the B-spline; one beyond each end, the neighbour reflected in the end point."""
    last = knots.shape[0] - 1
    if j < 0:
        return 2.0 * knots[0, u] - knots[wp.min(1, last), u]
    if j > last:
        return 2.0 * knots[last, u] - knots[wp.max(last - 1, 0), u]
    return knots[j, u]


@wp.func
def evaluate_spline(knots: wp.array2d[float], u: int, kind: int, tau: float) -> float:
    """Value of control u at time τ of the spline over ``knots [P, nu]`` (Howell et al. 2022, Eqs. 15-23).

    ``CUBIC`` is the Hermite cubic with finite-difference slopes; it passes through its knots and may overshoot them.
    ``BSPLINE`` is the uniform cubic B-spline, smooth to the second derivative and within the hull of its knots: each
    end point is interpolated because the control polygon goes on beyond it by reflection (natural ends).
    """
    last = knots.shape[0] - 1

    if kind == ZERO:
        return knots[wp.clamp(int(wp.floor(tau + KNOT_TOLERANCE)), 0, last), u]

    # segment i, from knot i to i + 1, and the place x in [0, 1] on it
    held = wp.clamp(tau, 0.0, float(last))
    i = wp.clamp(int(wp.floor(held)), 0, wp.max(last - 1, 0))
    j = wp.min(i + 1, last)
    x = held - float(i)

    if kind == LINEAR:
        return (1.0 - x) * knots[i, u] + x * knots[j, u]

    xx = x * x
    xxx = xx * x
    if kind == CUBIC:
        value = (2.0 * xxx - 3.0 * xx + 1.0) * knots[i, u] + (3.0 * xx - 2.0 * xxx) * knots[j, u]
        return value + (xxx - 2.0 * xx + x) * knot_slope(knots, i, u) + (xxx - xx) * knot_slope(knots, j, u)

    y = 1.0 - x
    value = y * y * y * control_point(knots, i - 1, u) + (3.0 * xxx - 6.0 * xx + 4.0) * control_point(knots, i, u)
    value += (1.0 + 3.0 * (x + xx - xxx)) * control_point(knots, i + 1, u) + xxx * control_point(knots, i + 2, u)
    return value / 6.0


@wp.kernel
def spline_control_kernel(
    # inputs
    knots: wp.array4d[float],  # [E, S, P, nu]
    lower: wp.array[float],  # [nu]
    upper: wp.array[float],  # [nu]
    kind: int,
    knot_dt: float,
    control_dt: float,
    domains: int,
    # outputs
    control: wp.array3d[float],  # [T, W, nu] within the limits
):
    """Evaluate the spline of one world's sample at one control step; all domains of a sample get the same controls."""
    t, w = wp.tid()

    row = w // domains
    e = row // knots.shape[1]
    s = row % knots.shape[1]

    tau = float(t) * (control_dt / knot_dt)
    for u in range(control.shape[2]):
        control[t, w, u] = wp.clamp(evaluate_spline(knots[e, s], u, kind, tau), lower[u], upper[u])


@wp.kernel
def shift_knots_kernel(
    # inputs
    mean: wp.array3d[float],  # [E, P, nu]
    kind: int,
    shift: float,
    knot_dt: float,
    # outputs
    mean_out: wp.array3d[float],  # [E, P, nu] another array than mean
):
    """Re-sample one knot of the plan ``shift`` seconds later, the last control held (Howell et al. 2022, Alg. 5).

    A zero-order plan of P = T knots moves by exactly one control per step. B-spline control points are interpolated
    (Catmull-Rom) rather than replaced by curve values, which would smooth the plan a little more at every shift.
    """
    e, p, u = wp.tid()

    interpolating = wp.where(kind == BSPLINE, CUBIC, kind)
    mean_out[e, p, u] = evaluate_spline(mean[e], u, interpolating, float(p) + shift / knot_dt)


@wp.kernel
def command_kernel(
    # inputs
    mean: wp.array3d[float],  # [E, P, nu]
    lower: wp.array[float],  # [nu]
    upper: wp.array[float],  # [nu]
    kind: int,
    time: float,
    knot_dt: float,
    # outputs
    command: wp.array2d[float],  # [E, nu] within the limits
):
    """Evaluate one control of one environment's plan ``time`` seconds after its first knot."""
    e, u = wp.tid()
    command[e, u] = wp.clamp(evaluate_spline(mean[e], u, kind, time / knot_dt), lower[u], upper[u])
