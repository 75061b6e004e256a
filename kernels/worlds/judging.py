# SPDX-License-Identifier: Apache-2.0
"""Before and after a launch that rolls out and judges: which knots make a control, and what a sample costs.

A module of its own, without kernels that work in blocks: several threads launch these at once on the CPU, and Warp's
storage for blocks is one per module there.
"""

import warp as wp

from ..planning.costs import domain_share, sample_risk, stage_risk_ratio
from ..planning.splines import Spline, evaluate_spline, knot_place, locate

wp.set_module_options({"enable_backward": False})

TAPS = wp.constant(4)
"""Most knots that a control depends on."""


@wp.struct
class TermSums:
    """Sums of cost terms over the steps of rollouts, and what they are weighed by, for terms inside a launch."""

    dt: wp.array[float]  # [T] [s]
    step_weight: wp.array[float]  # [T]
    weight: wp.array2d[float]  # [E, term]
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


@wp.kernel
def finish_kernel(
    # inputs
    stage_cost: wp.array3d[float],  # [term, T, W] of terms that were not summed on the way, or empty
    staged: wp.array[int],  # [n] which they are
    step_weight: wp.array[float],  # [T]
    stage_risk: float,  # R of ρ(l; R); where it is not zero every term is staged
    failed: wp.array[int],  # [W] nonzero where the physics failed; empty where there is none
    observed: wp.array[int],  # [E] whether there is an observation to plan from
    domains: int,
    mode: int,
    alpha: float,
    first: int,  # e·S + s of thread 0
    # outputs
    total: wp.array2d[float],  # [term, W] cost of each term over the horizon
    rollout_cost: wp.array[float],  # [W] S_w = Σ_t γ^t ρ(Σ_i c_i), +inf where it is not finite or the physics failed
    diverged: wp.array[int],  # [W] nonzero where the physics failed, or without it, where a cost is not finite
    cost: wp.array2d[float],  # [E, S]
):
    """One thread: one sample's cost, from the terms' over the horizon in each of its domains."""
    row = first + wp.tid()
    for w in range(row * domains, (row + 1) * domains):
        for n in range(staged.shape[0]):
            i = staged[n]
            part = float(0.0)
            for t in range(stage_cost.shape[1]):
                part += step_weight[t] * stage_risk_ratio(stage_cost, t, w, stage_risk) * stage_cost[i, t, w]
            total[i, w] = part
        sum = float(0.0)
        for i in range(total.shape[0]):
            sum += total[i, w]
        good = wp.isfinite(sum)
        if failed.shape[0] > 0:
            good = good and failed[w] == 0
        else:
            diverged[w] = wp.where(good, 0, 1)
        # a world that diverged must never look cheap
        rollout_cost[w] = wp.where(good, sum, wp.inf)
    e = row // cost.shape[1]
    risk = sample_risk(rollout_cost, row * domains, domains, mode, alpha)
    cost[e, row % cost.shape[1]] = wp.where(observed[e] != 0, risk, wp.inf)


@wp.kernel
def explain_total_kernel(
    # inputs
    total: wp.array2d[float],  # [term, W]
    rollout_cost: wp.array[float],  # [W]
    sample: wp.array[int],  # [E]
    samples: int,
    domains: int,
    mode: int,
    alpha: float,
    # outputs
    term_cost: wp.array2d[float],  # [E, term]
):
    """One thread: what one term added to the cost of one environment's sample, over its domains."""
    e, i = wp.tid()
    first = (e * samples + sample[e]) * domains
    added = float(0.0)
    for d in range(domains):
        added += domain_share(rollout_cost, first, domains, d, mode, alpha) * total[i, first + d]
    term_cost[e, i] = added
