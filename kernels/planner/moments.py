# SPDX-License-Identifier: Apache-2.0
"""Weighted moments of the samples: the mean moves towards them, and how they spread about it.

Every sum exists twice. On a GPU one block adds up one number. On the CPU one thread goes through the samples in the
order of memory and adds to all numbers at once, which is twenty times as fast as number by number; sums are made in
the same order either way. A column c = p·nu + u is one control at one knot.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

# a product that is rounded before it is added, as where Warp writes the sum: a fused one would differ in the last bit
_ROUNDED = """
#ifdef __clang__
#pragma clang fp contract(off)
#endif
    int columns = knots.shape[2];
    const float* __restrict__ row = knots.data + ((size_t)e * knots.shape[1] + s) * columns;
"""


@wp.func_native(
    _ROUNDED
    + """
    float* __restrict__ sum = sums.data + (size_t)e * sums.shape[1] * columns;
    for (int c = 0; c < columns; ++c) sum[c] = sum[c] + weight * row[c];
"""
)
def add_sample(knots: wp.array3d[float], weight: float, e: int, s: int, sums: wp.array3d[float]):
    """Add w θ of one sample to the first sums of every column."""
    ...


@wp.func_native(
    _ROUNDED
    + """
    const float* __restrict__ low = lower.data;
    const float* __restrict__ high = upper.data;
    const float* __restrict__ about = mean.data + (size_t)e * columns;
    float* __restrict__ deviation = sums.data + ((size_t)e * sums.shape[1] + 1) * columns;
    float* __restrict__ outside = deviation + columns;
    for (int c = 0; c < columns; ++c) {
        deviation[c] = deviation[c] + (row[c] - about[c]);
        outside[c] = outside[c] + (row[c] < low[c] || row[c] > high[c] ? 1.0f : 0.0f);
    }
"""
)
def add_drawn(
    knots: wp.array3d[float],
    mean: wp.array2d[float],
    lower: wp.array[float],
    upper: wp.array[float],
    e: int,
    s: int,
    sums: wp.array3d[float],
):
    """Add θ-μ of one sample to the second sums of every column, and whether it is outside the limits to the third."""
    ...


@wp.func
def moved_mean(
    mean: float,
    alpha: float,
    weighted: float,
    total: float,
    noise: float,
    deviation: float,
    outside: float,
    lower: float,
    upper: float,
):
    """One number of the mean after a step α towards Σwθ/Σw, without the part that is noise where a limit was met.

    That part is the sum of the drawn samples' deviations, as a control variate of the weighted one.
    """
    moved = (1.0 - alpha) * mean + alpha * weighted / total
    if outside > 0.0:
        moved -= alpha * noise * deviation
    return wp.clamp(moved, lower, upper)


@wp.func
def share_of_noise(total: float, squares: float, weighted_variance: float, variance: float):
    """Share of the sum of all deviations that a weighted mean of noise has.

    With weights that do not depend on it Σw(θ-μ)/Σw and Σ(θ-μ) have the covariance σ² Σws²/Σw, s² the samples'
    ``variance``, and the second has the variance σ² Σs². One sample that has all weight is taken as it is.
    """
    if variance <= 0.0:
        return 0.0
    return (1.0 - squares / (total * total)) * weighted_variance / (total * variance)


@wp.func_native(
    _ROUNDED
    + """
    const float* __restrict__ about = mean.data + (size_t)e * columns;
    float* __restrict__ plain = deviation.data + (size_t)e * 2 * columns;
    float* __restrict__ weighted = plain + columns;
    for (int c = 0; c < columns; ++c) {
        plain[c] = row[c] - about[c];
        weighted[c] = weight * plain[c];
    }
    for (int lag = 0; lag < products.shape[1]; ++lag) {
        float* __restrict__ sum = products.data + ((size_t)e * products.shape[1] + lag) * columns;
        for (int c = 0; c < columns - lag; ++c) sum[c] = sum[c] + weighted[c] * plain[c + lag];
    }
"""
)
def add_products(
    knots: wp.array3d[float],
    mean: wp.array2d[float],
    weight: float,
    e: int,
    s: int,
    deviation: wp.array3d[float],
    products: wp.array3d[float],
):
    """Add w (θ-μ)_c (θ-μ)_{c+lag} of one sample to sums of every column and lag."""
    ...


@wp.kernel
def update_mean_kernel(
    # inputs
    knots: wp.array3d[float],  # [E, S, P·nu]
    weight: wp.array2d[float],  # [E, S]
    variance: wp.array[float],  # [S] of the samples' noise, relative, 0 where they are not drawn
    tried: int,  # samples
    lower: wp.array[float],  # [P·nu]
    upper: wp.array[float],  # [P·nu]
    alpha: float,
    # outputs
    mean: wp.array2d[float],  # [E, P·nu] updated in place
):
    """Move one number of the mean, one block each, μ ← (1-α)μ + α Σwθ/Σw (Bhardwaj et al. 2021, Eq. 4).

    The mean stays where it is when all weights are zero.
    """
    e, c, lane = wp.tid()

    partial = float(0.0)
    partial_weight = float(0.0)
    partial_squares = float(0.0)
    partial_weighted = float(0.0)
    partial_variance = float(0.0)
    partial_deviation = float(0.0)
    partial_outside = float(0.0)
    for s in range(lane, tried, wp.block_dim()):
        w = weight[e, s]
        theta = knots[e, s, c]
        partial += w * theta
        partial_weight += w
        partial_squares += w * w
        partial_weighted += w * variance[s]
        partial_variance += variance[s]
        if variance[s] > 0.0:
            partial_deviation += theta - mean[e, c]
            partial_outside += wp.where(theta < lower[c] or theta > upper[c], 1.0, 0.0)
    weighted = wp.tile_extract(wp.tile_sum(wp.tile(partial)), 0)
    total = wp.tile_extract(wp.tile_sum(wp.tile(partial_weight)), 0)
    squares = wp.tile_extract(wp.tile_sum(wp.tile(partial_squares)), 0)
    weighted_variance = wp.tile_extract(wp.tile_sum(wp.tile(partial_weighted)), 0)
    added_variance = wp.tile_extract(wp.tile_sum(wp.tile(partial_variance)), 0)
    deviation = wp.tile_extract(wp.tile_sum(wp.tile(partial_deviation)), 0)
    outside = wp.tile_extract(wp.tile_sum(wp.tile(partial_outside)), 0)

    if lane == 0 and total > 0.0:
        noise = share_of_noise(total, squares, weighted_variance, added_variance)
        mean[e, c] = moved_mean(mean[e, c], alpha, weighted, total, noise, deviation, outside, lower[c], upper[c])


@wp.kernel
def sweep_mean_kernel(
    # inputs
    knots: wp.array3d[float],  # [E, S, P·nu]
    weight: wp.array2d[float],  # [E, S]
    variance: wp.array[float],  # [S] of the samples' noise, relative, 0 where they are not drawn
    tried: int,  # samples
    lower: wp.array[float],  # [P·nu]
    upper: wp.array[float],  # [P·nu]
    alpha: float,
    # outputs
    sums: wp.array3d[float],  # [E, 3, P·nu] scratch: weighted, deviation of the drawn ones, outside the limits
    mean: wp.array2d[float],  # [E, P·nu] updated in place
):
    """One thread on the CPU: what ``update_mean_kernel`` does, for one environment."""
    e = wp.tid()

    for i in range(3):
        for c in range(mean.shape[1]):
            sums[e, i, c] = 0.0
    total = float(0.0)
    squares = float(0.0)
    weighted_variance = float(0.0)
    added_variance = float(0.0)
    for s in range(tried):
        w = weight[e, s]
        total += w
        squares += w * w
        weighted_variance += w * variance[s]
        added_variance += variance[s]
        if w != 0.0:
            add_sample(knots, w, e, s, sums)
        if variance[s] > 0.0:
            add_drawn(knots, mean, lower, upper, e, s, sums)
    if total > 0.0:
        noise = share_of_noise(total, squares, weighted_variance, added_variance)
        for c in range(mean.shape[1]):
            deviation, outside = sums[e, 1, c], sums[e, 2, c]
            mean[e, c] = moved_mean(
                mean[e, c], alpha, sums[e, 0, c], total, noise, deviation, outside, lower[c], upper[c]
            )


@wp.kernel
def spread_kernel(
    # inputs
    knots: wp.array3d[float],  # [E, S, P·nu]
    weight: wp.array2d[float],  # [E, S]
    mean: wp.array2d[float],  # [E, P·nu]
    # outputs
    products: wp.array3d[float],  # [E, lags, P·nu]
    total: wp.array[float],  # [E] sum of the weights
):
    """Add up products Σ w (θ-μ)_c (θ-μ)_{c+lag} of one column with the one ``lag`` controls later, one block each.

    With lag 0 these are the variances. Products with a column of the next knot mean nothing and are not read.
    """
    e, lag, c, lane = wp.tid()

    other = wp.min(c + lag, knots.shape[2] - 1)
    partial = float(0.0)
    partial_weight = float(0.0)
    for s in range(lane, weight.shape[1], wp.block_dim()):
        partial += weight[e, s] * (knots[e, s, c] - mean[e, c]) * (knots[e, s, other] - mean[e, other])
        partial_weight += weight[e, s]
    added = wp.tile_extract(wp.tile_sum(wp.tile(partial)), 0)
    total_weight = wp.tile_extract(wp.tile_sum(wp.tile(partial_weight)), 0)

    if lane == 0:
        products[e, lag, c] = added
        if lag == 0 and c == 0:
            total[e] = total_weight


@wp.kernel
def sweep_spread_kernel(
    # inputs
    knots: wp.array3d[float],  # [E, S, P·nu]
    weight: wp.array2d[float],  # [E, S]
    mean: wp.array2d[float],  # [E, P·nu]
    # outputs
    deviation: wp.array3d[float],  # [E, 2, P·nu] scratch
    products: wp.array3d[float],  # [E, lags, P·nu]
    total: wp.array[float],  # [E] sum of the weights
):
    """One thread on the CPU: what ``spread_kernel`` does, for one environment."""
    e = wp.tid()

    for lag in range(products.shape[1]):
        for c in range(products.shape[2]):
            products[e, lag, c] = 0.0
    total_weight = float(0.0)
    for s in range(weight.shape[1]):
        w = weight[e, s]
        total_weight += w
        if w != 0.0:
            add_products(knots, mean, w, e, s, deviation, products)
    total[e] = total_weight


@wp.kernel
def keep_best_kernel(
    # inputs
    cost: wp.array2d[float],  # [E, S]
    knots: wp.array3d[float],  # [E, S, P·nu]
    # outputs
    best: wp.array3d[float],  # [n, E, P·nu]
):
    """Keep the n best samples of one environment, one block each, the best first, of equally good ones the first.

    What was kept before stays where fewer samples are finite.
    """
    e, lane = wp.tid()
    samples = cost.shape[1]

    bound = float(-wp.inf)  # cost and sample of the one kept last
    last = int(-1)
    for i in range(best.shape[0]):
        least = float(wp.inf)
        for s in range(lane, samples, wp.block_dim()):
            if wp.isfinite(cost[e, s]) and (cost[e, s] > bound or (cost[e, s] == bound and s > last)):
                least = wp.min(least, cost[e, s])
        lowest = wp.tile_extract(wp.tile_min(wp.tile(least)), 0)
        candidate = int(samples)
        for s in range(lane, samples, wp.block_dim()):
            if wp.isfinite(cost[e, s]) and cost[e, s] == lowest and (lowest > bound or s > last):
                candidate = wp.min(candidate, s)
        winner = wp.tile_extract(wp.tile_min(wp.tile(candidate)), 0)

        if winner < samples:
            for c in range(lane, best.shape[2], wp.block_dim()):
                best[i, e, c] = knots[e, winner, c]
        bound = lowest
        last = winner
