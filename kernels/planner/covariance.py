# SPDX-License-Identifier: Apache-2.0
"""The covariance that samples are drawn with follows the weighted samples (Bhardwaj et al. 2021, Eq. 5)."""

import warp as wp

wp.set_module_options({"enable_backward": False})

KNOTS = wp.constant(0)
DIAGONAL = wp.constant(1)

LANES = 32
"""Threads per environment of the kernels over a full covariance: those of one warp, which wait for each other."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncwarp();
#endif
""")
def wait_for_lanes():
    """Wait until all lanes of a warp have come here, and see what they wrote."""
    ...


@wp.kernel
def adapt_sigma_kernel(
    # inputs
    products: wp.array3d[float],  # [E, 1, P·nu] Σ w (θ-μ)², about the new mean
    total: wp.array[float],  # [E] Σ w
    schedule: wp.array2d[float],  # [iteration, P] factor on σ that the samples were drawn with
    iteration: int,
    form: int,
    alpha: float,
    sigma_min: wp.array[float],  # [nu] floor of the standard deviation
    # outputs
    sigma: wp.array3d[float],  # [E, P, nu] updated in place
):
    """One thread: σ² ← (1-α)σ² + α Σw(θ-μ)²/Σw of one control (Bhardwaj et al. 2021, Eq. 5).

    The form says what shares one σ: nothing, or all knots of a control (the mean over them, as in STORM's code). The
    schedule is taken out again, so that σ is that of samples drawn without it. With α = 1 the new σ is the spread of
    the weighted samples themselves; it stays where it is when all weights are zero.
    """
    e, u = wp.tid()
    knots = sigma.shape[1]
    nu = sigma.shape[2]
    if total[e] <= 0.0:
        return

    shared = float(0.0)
    if form != KNOTS:
        for p in range(knots):
            scale = schedule[iteration, p] * schedule[iteration, p]
            shared += products[e, 0, p * nu + u] / scale
        shared = shared / float(knots)
    for p in range(knots):
        spread = float(shared)
        if form == KNOTS:
            spread = products[e, 0, p * nu + u] / (schedule[iteration, p] * schedule[iteration, p])
        variance = (1.0 - alpha) * sigma[e, p, u] * sigma[e, p, u] + alpha * spread / total[e]
        sigma[e, p, u] = wp.max(wp.sqrt(variance), sigma_min[u])


@wp.kernel
def grow_sigma_kernel(
    # inputs
    observed: wp.array[int],  # [E] whether there is an observation to plan from
    fresh: wp.array[int],  # [E] whether nothing has been planned yet
    kappa: wp.array[float],  # [nu]
    # outputs
    sigma: wp.array3d[float],  # [E, P, nu] updated in place
):
    """One thread: σ² ← σ² + κ of one control, for a plan that moves on (STORM's code)."""
    e, u = wp.tid()
    if observed[e] == 0 or fresh[e] != 0:
        return
    for p in range(sigma.shape[1]):
        sigma[e, p, u] = wp.sqrt(sigma[e, p, u] * sigma[e, p, u] + kappa[u])


@wp.func
def factorize(
    covariance: wp.array3d[float],
    sigma_min: wp.array[float],
    i: int,
    per_env: int,
    lane: int,
    factor: wp.array3d[float],
    bands: wp.array3d[float],
):
    """Cholesky factor L of Σ_i and its bands, for all lanes of a warp; the rows below a pivot are shared among them.

    A pivot is the variance that a control has left once those before it are known. It is kept at σ_min² or above, as
    in Σ plus something on its diagonal, which is what Σ becomes: few samples span fewer directions than there are
    controls, and rounding takes one more.
    """
    count = covariance.shape[1]
    for j in range(count):
        known = float(0.0)
        for k in range(j):
            known += factor[i, j, k] * factor[i, j, k]
        pivot = wp.max(covariance[i, j, j] - known, sigma_min[j] * sigma_min[j])
        root = wp.sqrt(pivot)
        wait_for_lanes()
        for v in range(j + 1 + lane, count, wp.block_dim()):
            rest = float(covariance[i, v, j])
            for k in range(j):
                rest -= factor[i, v, k] * factor[i, j, k]
            factor[i, v, j] = wp.where(root > 0.0, rest / root, 0.0)
        if lane == 0:
            factor[i, j, j] = root
            covariance[i, j, j] = known + pivot
        wait_for_lanes()
    columns = bands.shape[2] // per_env
    first = (i % per_env) * columns
    for c in range(first + lane, first + columns, wp.block_dim()):
        u = c % count
        for lag in range(u + 1):
            bands[i // per_env, lag, c] = factor[i, u, u - lag]


@wp.kernel
def adapt_covariance_kernel(
    # inputs
    products: wp.array3d[float],  # [E, nu, P·nu] Σ w (θ-μ)_u (θ-μ)_{u+lag}, about the new mean
    total: wp.array[float],  # [E] Σ w
    schedule: wp.array2d[float],  # [iteration, P] factor on the deviation that the samples were drawn with
    iteration: int,
    alpha: float,
    sigma_min: wp.array[float],  # [nu]
    # outputs
    covariance: wp.array3d[float],  # [E·n, nu, nu] updated in place
    factor: wp.array3d[float],  # [E·n, nu, nu] lower triangular
    bands: wp.array3d[float],  # [E, nu, P·nu] its bands, L[u, u-lag] at column p·nu + u, zero where there is none
):
    """One warp: Σ ← (1-α)Σ + α Σw(θ-μ)(θ-μ)ᵀ/Σw of one covariance, and its Cholesky factor.

    Bhardwaj et al. 2021, Eq. 5: of n = P covariances of an environment each has its own knot's spread, Σ_h of the
    paper. The only one is shared by all knots, and has the mean over them, as in their code (``full_AxA``). Launch it
    with ``LANES`` threads per block.
    """
    i, lane = wp.tid()
    nu = covariance.shape[1]
    per_env = covariance.shape[0] // total.shape[0]
    knots = products.shape[2] // nu // per_env
    first = (i % per_env) * knots
    e = i // per_env
    if total[e] <= 0.0:
        return

    for entry in range(lane, nu * nu, wp.block_dim()):
        u = entry // nu
        v = entry % nu
        if v <= u:
            shared = float(0.0)
            for p in range(first, first + knots):
                shared += products[e, u - v, p * nu + v] / (schedule[iteration, p] * schedule[iteration, p])
            target = shared / float(knots) / total[e]
            covariance[i, u, v] = (1.0 - alpha) * covariance[i, u, v] + alpha * target
            covariance[i, v, u] = covariance[i, u, v]
    wait_for_lanes()
    factorize(covariance, sigma_min, i, per_env, lane, factor, bands)


@wp.kernel
def grow_covariance_kernel(
    # inputs
    observed: wp.array[int],  # [E] whether there is an observation to plan from
    fresh: wp.array[int],  # [E] whether nothing has been planned yet
    kappa: wp.array[float],  # [nu]
    sigma_min: wp.array[float],  # [nu]
    # outputs
    covariance: wp.array3d[float],  # [E·n, nu, nu] updated in place
    factor: wp.array3d[float],  # [E·n, nu, nu] lower triangular
    bands: wp.array3d[float],  # [E, nu, P·nu] its bands, L[u, u-lag] at column p·nu + u, zero where there is none
):
    """One warp: Σ ← Σ + κI of one covariance whose plan moves on (STORM's code), and its Cholesky factor."""
    i, lane = wp.tid()
    per_env = covariance.shape[0] // fresh.shape[0]
    e = i // per_env
    if observed[e] == 0 or fresh[e] != 0:
        return
    for u in range(lane, covariance.shape[1], wp.block_dim()):
        covariance[i, u, u] = covariance[i, u, u] + kappa[u]
    wait_for_lanes()
    factorize(covariance, sigma_min, i, per_env, lane, factor, bands)
