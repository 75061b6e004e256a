# SPDX-License-Identifier: Apache-2.0
"""Splines over knots: knots to controls, the plan re-sampled later, the command of this moment.

Places on a spline are counted in knots: knot j stands at τ = j, whatever the times of the knots, and outside [0, P-1]
the end value is held.
"""

import warp as wp

ZERO = wp.constant(0)
LINEAR = wp.constant(1)
CUBIC = wp.constant(2)
BSPLINE = wp.constant(3)

# a knot counts as reached this much early: t·control_dt/knot_dt may round to just below a whole number
KNOT_TOLERANCE = wp.constant(1.0e-4)


@wp.struct
class Spline:
    """Common data of the knots of all plans: their times and the kind of spline over them."""

    kind: int
    even: int  # whether all knots are equally far apart
    knot_dt: float  # [s] from the first knot to the second
    time: wp.array[float]  # [P] seconds after the first knot
    interval: wp.array[float]  # [P] from each knot to the next, in units of knot_dt; the last one repeats


@wp.func
def knot_place(s: Spline, time: float) -> float:
    """Place τ of a time [s] after the first knot; beyond the last knot it goes on at the last interval's pace."""
    if s.even != 0:
        return time / s.knot_dt
    last = s.time.shape[0] - 1
    j = int(0)
    while j < last - 1 and s.time[j + 1] <= time:
        j += 1
    return float(j) + (time - s.time[j]) / (s.interval[j] * s.knot_dt)


@wp.func
def knot_slope(knots: wp.array2d[float], s: Spline, j: int, u: int) -> float:
    """Slope at knot j per first interval: mean of both sides, one-sided at the ends (Howell et al. 2022, Eqs. 17, 18).

    Written as the central difference of equal intervals and what unequal ones add, which is then exactly zero.
    """
    last = knots.shape[0] - 1
    before = wp.max(j - 1, 0)
    after = wp.min(j + 1, last)
    sides = wp.max(float(after - before), 1.0)
    uneven = (knots[after, u] - knots[j, u]) * (1.0 / s.interval[j] - 1.0)
    uneven += (knots[j, u] - knots[before, u]) * (1.0 / s.interval[before] - 1.0)
    return (knots[after, u] - knots[before, u]) / sides + uneven / sides


@wp.func
def control_point(knots: wp.array2d[float], j: int, u: int) -> float:
    """Control point j of the B-spline; one beyond each end, the neighbour reflected in the end point."""
    last = knots.shape[0] - 1
    if j < 0:
        return 2.0 * knots[0, u] - knots[wp.min(1, last), u]
    if j > last:
        return 2.0 * knots[last, u] - knots[wp.max(last - 1, 0), u]
    return knots[j, u]


@wp.struct
class SplinePlace:
    """Place of a time on a spline, the same for all controls."""

    i: int  # knot before it
    j: int  # knot after it
    x: float  # share of the way between the two, in [0, 1]


@wp.func
def locate(count: int, kind: int, tau: float) -> SplinePlace:
    """Segment of a place τ among ``count`` knots; before the first and after the last knot the end is held."""
    last = count - 1
    place = SplinePlace()
    if kind == ZERO:
        place.i = wp.clamp(int(wp.floor(tau + KNOT_TOLERANCE)), 0, last)
        place.j = place.i
        place.x = 0.0
        return place
    held = wp.clamp(tau, 0.0, float(last))
    place.i = wp.clamp(int(wp.floor(held)), 0, wp.max(last - 1, 0))
    place.j = wp.min(place.i + 1, last)
    place.x = held - float(place.i)
    return place


@wp.func
def evaluate_spline(knots: wp.array2d[float], s: Spline, kind: int, u: int, place: SplinePlace) -> float:
    """Value of control u at a place of the spline over ``knots [P, nu]`` (Howell et al. 2022, Eqs. 15-23).

    ``CUBIC`` is the Hermite cubic with finite-difference slopes; it passes through its knots and may overshoot them.
    ``BSPLINE`` is the uniform cubic B-spline in τ, smooth to the second derivative and within the hull of its knots:
    each end point is interpolated because the control polygon goes on beyond it by reflection (natural ends).
    """
    i = place.i
    j = place.j
    x = place.x
    if kind == ZERO:
        return knots[i, u]
    if kind == LINEAR:
        return (1.0 - x) * knots[i, u] + x * knots[j, u]

    xx = x * x
    xxx = xx * x
    if kind == CUBIC:
        value = (2.0 * xxx - 3.0 * xx + 1.0) * knots[i, u] + (3.0 * xx - 2.0 * xxx) * knots[j, u]
        first = s.interval[i] * knot_slope(knots, s, i, u)
        second = s.interval[i] * knot_slope(knots, s, j, u)
        return value + (xxx - 2.0 * xx + x) * first + (xxx - xx) * second

    y = 1.0 - x
    value = y * y * y * control_point(knots, i - 1, u) + (3.0 * xxx - 6.0 * xx + 4.0) * control_point(knots, i, u)
    value += (1.0 + 3.0 * (x + xx - xxx)) * control_point(knots, i + 1, u) + xxx * control_point(knots, i + 2, u)
    return value / 6.0


@wp.kernel
def advance_plan_kernel(
    # inputs
    s: Spline,
    elapsed: wp.array[float],  # [E] time since the last plan [s]
    # outputs
    offset: wp.array[float],  # [E] time from the first knot to now [s], updated in place
    shift: wp.array[float],  # [E] how far the knots move [s]
):
    """One thread: by how much the knots of one environment move.

    Smooth plans move by the time that has passed, so that the first knot stands at the present. Evenly spaced knots of
    zero order move by whole intervals alone, the rest becomes ``offset``: re-sampled in between, they would keep their
    values and the plan would never move.
    """
    e = wp.tid()
    if s.kind == ZERO and s.even != 0:
        total = offset[e] + elapsed[e]
        whole = wp.floor(total / s.knot_dt + KNOT_TOLERANCE)
        shift[e] = whole * s.knot_dt
        offset[e] = wp.max(total - shift[e], 0.0)
    else:
        shift[e] = elapsed[e]


@wp.kernel
def shift_knots_kernel(
    # inputs
    knots: wp.array3d[float],  # [E, P, nu]
    s: Spline,
    kind: int,
    shift: wp.array[float],  # [E] [s]
    # outputs
    shifted: wp.array3d[float],  # [E, P, nu] another array than knots
):
    """One thread: one knot of the plan re-sampled ``shift`` seconds later, the last held (Howell et al. 2022, Alg. 5).

    B-spline control points are interpolated (Catmull-Rom) rather than replaced by curve values, which would smooth the
    plan a little more at every shift; unevenly spaced knots of zero order are interpolated linearly.
    """
    e, p, u = wp.tid()

    interpolating = wp.where(kind == BSPLINE, CUBIC, kind)
    place = float(p) + shift[e] / s.knot_dt
    if s.even == 0:
        place = knot_place(s, s.time[p] + shift[e])
        interpolating = wp.max(interpolating, LINEAR)
    shifted[e, p, u] = evaluate_spline(knots[e], s, interpolating, u, locate(knots.shape[1], interpolating, place))


@wp.kernel
def spline_control_kernel(
    # inputs
    knots: wp.array4d[float],  # [E, S, P, nu]
    s: Spline,
    lower: wp.array[float],  # [nu]
    upper: wp.array[float],  # [nu]
    step_time: wp.array[float],  # [T] time of each step after the present [s]
    step_place: wp.array[float],  # [T] the same in knots, for evenly spaced ones
    offset: wp.array[float],  # [E] time from the first knot to the present [s]
    domains: int,
    first: int,  # world of thread 0
    lanes: int,  # threads that share the steps of a world
    # outputs
    control: wp.array3d[float],  # [T, W, nu] within the limits
):
    """One thread: the controls of one world's sample at some steps; all domains of a sample get the same controls."""
    lane, thread = wp.tid()
    w = first + thread

    row = w // domains
    e = row // knots.shape[1]
    sample = row % knots.shape[1]

    own = knots[e, sample]
    for t in range(lane, control.shape[0], lanes):
        place = step_place[t] + offset[e] / s.knot_dt
        if s.even == 0:
            place = knot_place(s, step_time[t] + offset[e])
        at = locate(knots.shape[2], s.kind, place)
        for u in range(control.shape[2]):
            control[t, w, u] = wp.clamp(evaluate_spline(own, s, s.kind, u, at), lower[u], upper[u])


@wp.kernel
def command_kernel(
    # inputs
    mean: wp.array3d[float],  # [E, P, nu]
    s: Spline,
    lower: wp.array[float],  # [nu]
    upper: wp.array[float],  # [nu]
    offset: wp.array[float],  # [E] time from the first knot to the present [s]
    # outputs
    command: wp.array2d[float],  # [E, nu] within the limits
):
    """One thread: one control of one environment's plan at the present."""
    e, u = wp.tid()
    at = locate(mean.shape[1], s.kind, knot_place(s, offset[e]))
    command[e, u] = wp.clamp(evaluate_spline(mean[e], s, s.kind, u, at), lower[u], upper[u])
