# SPDX-License-Identifier: Apache-2.0
"""Inputs and sums of a launch that rolls out and evaluates cost terms.

A separate module, without kernels that work in blocks: several threads launch these at once on the CPU, and Warp's
storage for blocks is one per module there.
"""

import warp as wp

from ..planner.costs import CostWeights
from ..planner.splines import Spline, evaluate_spline, knot_place, locate

wp.set_module_options({"enable_backward": False})

TAPS = wp.constant(4)
"""Most knots that a control depends on."""


@wp.struct
class TermSums:
    """Sums of the cost terms inside a launch over the steps of rollouts, and the factors they are taken by."""

    dt: wp.array[float]  # [T] [s]
    weights: CostWeights
    total: wp.array2d[float]  # [term, W] cost of each term over the horizon


@wp.kernel
def taps_kernel(
    # inputs
    unit: wp.array3d[float],  # [P, P, 1] one knot after the other is one, all others zero
    s: Spline,
    step_time: wp.array[float],  # [T] time of each step after the present [s]
    step_place: wp.array[float],  # [T] the same in knots, for evenly spaced ones
    offset: wp.array[float],  # [E] time from the first knot to the present [s]
    # outputs
    tap: wp.array3d[int],  # [E, T, TAPS]
    share: wp.array3d[float],  # [E, T, TAPS]
):
    """One thread: the knots that the control of one step depends on, and how much; a spline is linear in its knots."""
    e, t = wp.tid()
    place = step_place[t] + offset[e] / s.knot_dt
    if s.even == 0:
        place = knot_place(s, step_time[t] + offset[e])
    at = locate(unit.shape[0], s.kind, place)
    for k in range(TAPS):
        # knots next to the first one of its segment, which comes first: with one tap it is the only one
        knot = at.i + k
        if k == TAPS - 1:
            knot = at.i - 1
        tap[e, t, k] = wp.clamp(knot, 0, unit.shape[0] - 1)
        share[e, t, k] = 0.0
        if knot >= 0 and knot < unit.shape[0]:
            share[e, t, k] = evaluate_spline(unit[knot], s, s.kind, 0, at)
