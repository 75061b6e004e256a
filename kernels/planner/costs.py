# SPDX-License-Identifier: Apache-2.0
"""From stage costs to sample costs: sums over terms and steps, risk over domains, what each term adds.

A separate module, without kernels that work in blocks: several threads launch these at once on the CPU, and Warp's
storage for blocks is one per module there.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

MEAN = wp.constant(0)
WORST = wp.constant(1)
CVAR = wp.constant(2)
BEST = wp.constant(3)
VAR = wp.constant(4)
EXPONENTIAL = wp.constant(5)

# a tail of this much more than whole domains is one of whole domains: α·D is rounded
TAIL_TOLERANCE = wp.constant(1.0e-4)


@wp.struct
class CostWeights:
    """Factors by which terms n_i become the cost of a rollout, Σ_t γ_t ρ(Σ_i τ_it w_i n_i) (``cost.stack``)."""

    term: wp.array2d[float]  # [E, term] w, which the task changes between plans
    terminal: wp.array2d[float]  # [T, term] τ: 1 or 0, and at the last step the term's terminal factor or 0
    discount: wp.array[float]  # [T] γ


@wp.func
def stage_weight(weights: CostWeights, e: int, t: int, i: int) -> float:
    """Factor τ_it w_i on what term i costs at step t."""
    return weights.terminal[t, i] * weights.term[e, i]


@wp.func
def risk_ratio(x: float) -> float:
    """(e^x - 1)/x."""
    if wp.abs(x) < 0.1:  # the difference below would cancel
        return 1.0 + x * (1.0 / 2.0 + x * (1.0 / 6.0 + x * (1.0 / 24.0 + x / 120.0)))
    return (wp.exp(x) - 1.0) / x


@wp.func
def stage_risk_ratio(stage_cost: wp.array3d[float], t: int, w: int, stage_risk: float) -> float:
    """ρ(l; R)/l of one step, ρ = (e^{R l} - 1)/R, l its cost over all terms (Howell et al. 2022, Eq. 5); 1 where R = 0.

    Every term's share grows by it, so that the terms still add up to the cost.
    """
    if stage_risk == 0.0:
        return 1.0
    x = float(0.0)
    for i in range(stage_cost.shape[0]):
        x += stage_risk * stage_cost[i, t, w]
    return risk_ratio(x)


@wp.func
def tail_part(rollout_cost: wp.array[float], first: int, domains: int, d: int, tail: float) -> float:
    """Share of domain d in the ``tail`` worst ones of a sample, in [0, 1]; rank by counting: D is small."""
    cost = rollout_cost[first + d]
    rank = int(0)
    for other in range(domains):
        rival = rollout_cost[first + other]
        if rival > cost or (rival == cost and other < d):
            rank += 1
    return wp.clamp(tail - float(rank), 0.0, 1.0)


@wp.func
def ranked_domain(rollout_cost: wp.array[float], first: int, domains: int, mode: int, alpha: float) -> int:
    """The best domain of a sample, or the mildest one of its worst share α (VaR); of equal ones the first is worse."""
    wanted = domains - 1
    if mode == VAR:
        wanted = wp.clamp(int(wp.ceil(alpha * float(domains) - TAIL_TOLERANCE)) - 1, 0, domains - 1)
    found = int(0)
    for d in range(domains):
        reaching = tail_part(rollout_cost, first, domains, d, float(wanted + 1))
        short = tail_part(rollout_cost, first, domains, d, float(wanted))
        if reaching > short:
            found = d
    return found


@wp.func
def domain_share(rollout_cost: wp.array[float], first: int, domains: int, d: int, mode: int, alpha: float) -> float:
    """Share of domain d in the cost of its sample (:func:`sample_risk`); the shares add up to one.

    Those of the exponential risk are its gradient e^{R S_d}/Σ e^{R S}, the probabilities that it sees.
    """
    if mode == MEAN:
        return 1.0 / float(domains)
    if mode == EXPONENTIAL:
        own = rollout_cost[first + d]
        total = float(0.0)
        for other in range(domains):
            total += wp.exp(alpha * (rollout_cost[first + other] - own))
        return 1.0 / total
    if mode == BEST or mode == VAR:
        return wp.where(d == ranked_domain(rollout_cost, first, domains, mode, alpha), 1.0, 0.0)
    tail = float(1.0)
    if mode == CVAR:
        tail = wp.max(alpha * float(domains), 1.0)
    return tail_part(rollout_cost, first, domains, d, tail) / tail


@wp.func
def exponential_risk(rollout_cost: wp.array[float], first: int, domains: int, aversion: float) -> float:
    """log(mean e^{R S})/R about the domain whose exponential is largest; the mean where R is zero."""
    mean = float(0.0)
    largest = rollout_cost[first]
    for d in range(domains):
        cost = rollout_cost[first + d]
        mean += cost / float(domains)
        if aversion * (cost - largest) > 0.0:
            largest = cost
    if aversion == 0.0:
        return mean
    total = float(0.0)
    for d in range(domains):
        total += wp.exp(aversion * (rollout_cost[first + d] - largest))
    return largest + wp.log(total / float(domains)) / aversion


@wp.func
def sample_risk(rollout_cost: wp.array[float], first: int, domains: int, mode: int, alpha: float) -> float:
    """Reduce one sample's costs over its domains: mean, worst, best, CVaR, VaR or the exponential risk.

    CVaR is the mean of the worst share α: α = 1 is the mean, α ≤ 1/D the worst; in between a domain may count in part
    (Rockafellar and Uryasev 2002). VaR is the mildest cost of that share. The exponential risk is log(mean e^{R S})/R
    (Whittle 1981), ``alpha`` its R. One diverged domain makes the sample +inf in every mode.
    """
    worst = float(-wp.inf)
    total = float(0.0)
    finite = bool(True)
    for d in range(domains):
        cost = rollout_cost[first + d]
        finite = finite and wp.isfinite(cost)
        worst = wp.max(worst, cost)
        total += cost

    risk = float(worst)
    if mode == MEAN:
        risk = total / float(domains)
    elif mode == CVAR and domains > 1:
        # the k worst domains count, the last of them in part; rank by counting: D is small
        tail = alpha * float(domains)
        if tail > 1.0:
            excess = float(0.0)
            for d in range(domains):
                excess += tail_part(rollout_cost, first, domains, d, tail) * rollout_cost[first + d]
            risk = excess / tail
    elif mode == BEST or mode == VAR:
        risk = rollout_cost[first + ranked_domain(rollout_cost, first, domains, mode, alpha)]
    elif mode == EXPONENTIAL:
        risk = exponential_risk(rollout_cost, first, domains, alpha)
    return wp.where(finite, risk, wp.inf)


@wp.kernel
def finish_kernel(
    # inputs
    stage_cost: wp.array3d[float],  # [term, T, W] of terms that are evaluated at every step, on the record
    on_record: wp.array[int],  # [n] which they are
    in_launch: wp.array[int],  # [m] all others, whose total is there already
    weights: CostWeights,
    stage_risk: float,  # R of ρ(l; R); where it is not zero every term is on the record
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
    sample_cost: wp.array2d[float],  # [E, S]
):
    """One thread: one sample's cost, from the terms' in each of its domains (Pezzato et al. 2025, Eq. 5).

    Without an observation it is +inf: nothing is learned from such rollouts.
    """
    row = first + wp.tid()
    for w in range(row * domains, (row + 1) * domains):
        cost = float(0.0)
        if on_record.shape[0] > 0:
            for n in range(on_record.shape[0]):
                total[on_record[n], w] = 0.0
            for t in range(stage_cost.shape[1]):
                factor = weights.discount[t] * stage_risk_ratio(stage_cost, t, w, stage_risk)
                for n in range(on_record.shape[0]):
                    i = on_record[n]
                    part = factor * stage_cost[i, t, w]
                    total[i, w] = total[i, w] + part
                    cost += part
        for n in range(in_launch.shape[0]):
            cost += total[in_launch[n], w]
        good = wp.isfinite(cost)
        if failed.shape[0] > 0:
            good = good and failed[w] == 0
        else:
            diverged[w] = wp.where(good, 0, 1)
        # a world that diverged must never look cheap
        rollout_cost[w] = wp.where(good, cost, wp.inf)
    e = row // sample_cost.shape[1]
    risk = sample_risk(rollout_cost, row * domains, domains, mode, alpha)
    sample_cost[e, row % sample_cost.shape[1]] = wp.where(observed[e] != 0, risk, wp.inf)


@wp.kernel
def explain_kernel(
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


@wp.kernel
def weigh_values_kernel(
    # inputs
    value: wp.array2d[float],  # [T, W] what a term over whole arrays returned
    weights: CostWeights,
    term: int,
    rollouts: int,  # worlds of an environment
    # outputs
    cost: wp.array3d[float],  # [term, T, W]
):
    """One thread: the cost of one step of one world; a term without weight is off, whatever it says."""
    t, w = wp.tid()
    factor = stage_weight(weights, w // rollouts, t, term)
    cost[term, t, w] = 0.0
    if factor != 0.0:
        cost[term, t, w] = factor * value[t, w]
