# SPDX-License-Identifier: Apache-2.0
"""From sample costs to sample weights.

A world that diverged costs +inf, and a sample of infinite cost carries no weight. Kernels whose docstring says
"one block" are launched with ``wp.launch_tiled``.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

# halvings of a β interval of ten decades: a relative width of 1e-6 remains
BISECTIONS = wp.constant(24)


@wp.func
def importance(cost: float, best: float, beta: float) -> float:
    """Unnormalised weight exp(-(S - ρ)/β), zero for a diverged sample (Pezzato et al. 2025, Eq. 3)."""
    if wp.isfinite(cost):
        return wp.exp(-(cost - best) / beta)
    return 0.0


@wp.func
def best_cost(cost: wp.array2d[float], e: int, lane: int) -> float:
    """Lowest finite cost ρ of environment e, for the whole block; +inf when every sample diverged."""
    best = float(wp.inf)
    for s in range(lane, cost.shape[1], wp.block_dim()):
        if wp.isfinite(cost[e, s]):
            best = wp.min(best, cost[e, s])
    return wp.tile_extract(wp.tile_min(wp.tile(best)), 0)


@wp.kernel
def importance_weight_kernel(
    # inputs
    cost: wp.array2d[float],  # [E, S]
    eta_bounds: wp.vec2,
    beta_bounds: wp.vec2,
    adapt: int,
    # outputs
    beta: wp.array[float],  # [E] temperature, adapted in place for the next step
    eta: wp.array[float],  # [E] number of samples that carry weight, before normalization
    weight: wp.array2d[float],  # [E, S] sums to one per environment, all zero when every sample diverged
):
    """Weigh the samples of one environment, one block each, and steer β (Pezzato et al. 2025, Eqs. 3 and 6).

    With ``adapt``, β ← 0.9 β where η is above its bounds and β ← 1.2 β where it is below; an environment whose samples
    all diverged says nothing about its temperature and keeps it.
    """
    e, lane = wp.tid()
    samples = cost.shape[1]

    temperature = beta[e]
    best = best_cost(cost, e, lane)

    partial = float(0.0)
    for s in range(lane, samples, wp.block_dim()):
        w = importance(cost[e, s], best, temperature)
        weight[e, s] = w
        partial += w
    total = wp.tile_extract(wp.tile_sum(wp.tile(partial)), 0)

    for s in range(lane, samples, wp.block_dim()):
        weight[e, s] = weight[e, s] / wp.max(total, 1.0)  # total ≥ 1 unless all diverged: the best has w = 1

    if lane == 0:
        eta[e] = total
        if adapt != 0 and total > 0.0:
            if total > eta_bounds[1]:
                temperature = 0.9 * temperature
            elif total < eta_bounds[0]:
                temperature = 1.2 * temperature
            beta[e] = wp.clamp(temperature, beta_bounds[0], beta_bounds[1])


@wp.kernel
def bisect_temperature_kernel(
    # inputs
    cost: wp.array2d[float],  # [E, S]
    target_ess: float,
    beta_bounds: wp.vec2,
    # outputs
    beta: wp.array[float],  # [E] kept where every sample diverged
):
    """Set β of one environment, one block each, so that the effective sample size (Σw)²/Σw² meets its target.

    The effective sample size grows with β, from the number of tied best samples to the number of finite ones; a
    target outside that range ends at a bound of β. Bisection on log β.
    """
    e, lane = wp.tid()

    best = best_cost(cost, e, lane)

    low = wp.log(beta_bounds[0])
    high = wp.log(beta_bounds[1])
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        temperature = wp.exp(middle)
        sums = wp.vec2(0.0, 0.0)
        for s in range(lane, cost.shape[1], wp.block_dim()):
            w = importance(cost[e, s], best, temperature)
            sums += wp.vec2(w, w * w)
        first = wp.tile_extract(wp.tile_sum(wp.tile(sums[0])), 0)
        second = wp.tile_extract(wp.tile_sum(wp.tile(sums[1])), 0)
        if first * first < target_ess * second:
            low = middle
        else:
            high = middle

    if lane == 0 and wp.isfinite(best):
        beta[e] = wp.exp(0.5 * (low + high))


@wp.kernel
def forget_cost_kernel(
    # inputs
    first: int,  # sample of thread 0
    # outputs
    cost: wp.array2d[float],  # [E, S]
):
    """One thread: a sample that a round does not try costs +inf."""
    e, s = wp.tid()
    cost[e, first + s] = wp.inf


@wp.func
def ordered(cost: float) -> int:
    """A whole number that is lower where a cost is lower: the bits of a float, those of negative ones turned round."""
    bits = wp.cast(cost, int)
    return wp.where(bits < 0, bits ^ 0x7FFFFFFF, bits)


@wp.func
def nth_cost(cost: wp.array2d[float], e: int, lane: int, n: int) -> float:
    """The n-th lowest finite cost of environment e, for the whole block; +inf where fewer are finite.

    Bisection over all floats, so that it takes S steps a bit and not S² in all.
    """
    low = int(-2139095040)  # the lowest finite float, ordered
    high = int(2139095040)  # +inf
    for _ in range(32):
        middle = (low >> 1) + (high >> 1) + (low & high & 1)
        partial = int(0)
        for s in range(lane, cost.shape[1], wp.block_dim()):
            if wp.isfinite(cost[e, s]) and ordered(cost[e, s]) <= middle:
                partial += 1
        count = wp.tile_extract(wp.tile_sum(wp.tile(partial)), 0)
        if count >= n:
            high = middle
        else:
            low = wp.min(middle + 1, high)
    return wp.cast(wp.where(high < 0, high ^ 0x7FFFFFFF, high), float)


@wp.kernel
def tsallis_weight_kernel(
    # inputs
    cost: wp.array2d[float],  # [E, S]
    elites: int,
    exponent: float,  # 1/(r - 1)
    # outputs
    eta: wp.array[float],  # [E] number of samples that carry weight, before normalization
    weight: wp.array2d[float],  # [E, S] sums to one per environment, all zero when every sample diverged
):
    """Weigh one environment's samples, one block each, by (1 - ΔS/γ)_+^{1/(r-1)} (Wang et al. 2021, 2104.00241).

    γ is what the first sample that is no elite costs more than the best one, so that the elites carry all weight;
    where no finite sample is left out, they weigh the same, and so do ties of the best where γ is zero.
    """
    e, lane = wp.tid()
    samples = cost.shape[1]

    best = best_cost(cost, e, lane)

    gamma = nth_cost(cost, e, lane, elites + 1) - best

    partial = float(0.0)
    for s in range(lane, samples, wp.block_dim()):
        w = float(0.0)
        if wp.isfinite(cost[e, s]):
            excess = cost[e, s] - best
            if excess == 0.0:
                w = 1.0
            elif excess < gamma:
                w = wp.pow(1.0 - excess / gamma, exponent)
        weight[e, s] = w
        partial += w
    total = wp.tile_extract(wp.tile_sum(wp.tile(partial)), 0)

    for s in range(lane, samples, wp.block_dim()):
        weight[e, s] = weight[e, s] / wp.max(total, 1.0)
    if lane == 0:
        eta[e] = total


@wp.kernel
def best_weight_kernel(
    # inputs
    cost: wp.array2d[float],  # [E, S]
    # outputs
    eta: wp.array[float],  # [E] 1, or 0 when every sample diverged
    weight: wp.array2d[float],  # [E, S] 1 for the best sample, all zero when every sample diverged
):
    """Give all weight of one environment, one block each, to its best sample (Howell et al. 2022, Alg. 4).

    Of equally good samples the first wins.
    """
    e, lane = wp.tid()
    samples = cost.shape[1]

    best = best_cost(cost, e, lane)

    candidate = int(samples)
    for s in range(lane, samples, wp.block_dim()):
        if wp.isfinite(cost[e, s]) and cost[e, s] == best:
            candidate = wp.min(candidate, s)
    winner = wp.tile_extract(wp.tile_min(wp.tile(candidate)), 0)

    for s in range(lane, samples, wp.block_dim()):
        weight[e, s] = wp.where(s == winner, 1.0, 0.0)

    if lane == 0:
        eta[e] = wp.where(winner < samples, 1.0, 0.0)


@wp.kernel
def elite_weight_kernel(
    # inputs
    cost: wp.array2d[float],  # [E, S]
    elites: int,
    # outputs
    eta: wp.array[float],  # [E] number of elites, fewer when fewer samples are finite
    weight: wp.array2d[float],  # [E, S] equal for the elites, all zero when every sample diverged
):
    """Weigh one environment's samples, one block each: 1/n for the n best, the first of equally good ones first.

    Cross-entropy method (Rubinstein 1999), n the number of elites, or of finite samples where these are fewer.
    """
    e, lane = wp.tid()
    samples = cost.shape[1]

    worst = nth_cost(cost, e, lane, elites)
    partial = int(0)
    for s in range(lane, samples, wp.block_dim()):
        if wp.isfinite(cost[e, s]) and cost[e, s] < worst:
            partial += 1
    better = wp.tile_extract(wp.tile_sum(wp.tile(partial)), 0)
    # with fewer finite samples than elites the worst elite costs +inf, and all of them are better
    count = wp.where(wp.isfinite(worst), elites, better)

    for s in range(lane, samples, wp.block_dim()):
        own = cost[e, s]
        chosen = wp.isfinite(own) and own < worst
        if wp.isfinite(own) and own == worst:
            before = better
            for other in range(s):
                if cost[e, other] == own:
                    before += 1
            chosen = before < elites
        weight[e, s] = wp.where(chosen, 1.0 / wp.max(float(count), 1.0), 0.0)
    if lane == 0:
        eta[e] = float(count)
