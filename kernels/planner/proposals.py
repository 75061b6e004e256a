# SPDX-License-Identifier: Apache-2.0
"""Candidate knots: shaped noise, samples about the mean, and rows that are not drawn.

Several threads launch these at once on the CPU: no kernel here works in blocks. Knots and controls are columns
c = p·nu + u of one row. On the CPU one thread takes a whole row in native loops, which the compiler turns into vector
instructions; on a GPU many threads share one. Products are rounded before they are added, as where Warp writes the sum.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

_ROUNDED = """
#ifdef __clang__
#pragma clang fp contract(off)
#endif
    int columns = knots.shape[2];
    float* __restrict__ out = knots.data + ((size_t)e * knots.shape[1] + s) * columns;
"""


@wp.func_native(
    _ROUNDED.replace("knots", "noise")
    + """
    const float* __restrict__ in = z.data + ((size_t)e * noise.shape[1] + s) * columns;
    for (int p = begin; p < end; ++p) {
        const float* row = shaping.data + (size_t)p * shaping.shape[1];
        float* to = out + p * nu;
        for (int u = 0; u < nu; ++u) {
            float sum = 0.0f;
            for (int q = 0; q < shaping.shape[1]; ++q) sum = sum + row[q] * in[q * nu + u];
            to[u] = sum;
        }
    }
"""
)
def shape_row(
    z: wp.array3d[float],
    shaping: wp.array2d[float],
    e: int,
    s: int,
    nu: int,
    begin: int,
    end: int,
    noise: wp.array3d[float],
):
    """Knots ``begin`` to ``end`` of B z of one sample."""
    ...


@wp.func_native(
    _ROUNDED
    + """
    float* __restrict__ free = drawn.data + ((size_t)e * knots.shape[1] + s) * columns;
    const float* __restrict__ in = noise.data + ((size_t)e * knots.shape[1] + s) * columns;
    const float* __restrict__ about = mean.data + (size_t)e * columns;
    const float* __restrict__ deviation = sigma.data + (size_t)e * columns;
    const float* __restrict__ factor = schedule.data + (size_t)iteration * columns;
    const float* __restrict__ low = lower.data;
    const float* __restrict__ high = upper.data;
    for (int c = begin; c < end; ++c) {
        free[c] = about[c] + factor[c] * deviation[c] * in[c];
        out[c] = wp::clamp(free[c], low[c], high[c]);
    }
"""
)
def perturb_row(
    mean: wp.array2d[float],
    sigma: wp.array2d[float],
    schedule: wp.array2d[float],
    iteration: int,
    noise: wp.array3d[float],
    lower: wp.array[float],
    upper: wp.array[float],
    e: int,
    s: int,
    begin: int,
    end: int,
    drawn: wp.array3d[float],
    knots: wp.array3d[float],
):
    """Columns ``begin`` to ``end`` of one sample about the mean, mean + f σ ⊙ (B z)."""
    ...


@wp.func_native(
    _ROUNDED
    + """
    float* __restrict__ free = drawn.data + ((size_t)e * knots.shape[1] + s) * columns;
    const float* __restrict__ in = noise.data + ((size_t)e * knots.shape[1] + s) * columns;
    const float* __restrict__ about = mean.data + (size_t)e * columns;
    const float* __restrict__ scale = schedule.data + (size_t)iteration * columns;
    for (int c = begin; c < end; ++c) free[c] = 0.0f;
    for (int lag = 0; lag < bands.shape[1]; ++lag) {
        const float* __restrict__ band = bands.data + ((size_t)e * bands.shape[1] + lag) * columns;
        for (int c = begin < lag ? lag : begin; c < end; ++c) free[c] = free[c] + band[c] * in[c - lag];
    }
    const float* __restrict__ low = lower.data;
    const float* __restrict__ high = upper.data;
    for (int c = begin; c < end; ++c) {
        free[c] = about[c] + scale[c] * free[c];
        out[c] = wp::clamp(free[c], low[c], high[c]);
    }
"""
)
def perturb_row_together(
    mean: wp.array2d[float],
    bands: wp.array3d[float],
    schedule: wp.array2d[float],
    iteration: int,
    noise: wp.array3d[float],
    lower: wp.array[float],
    upper: wp.array[float],
    e: int,
    s: int,
    begin: int,
    end: int,
    drawn: wp.array3d[float],
    knots: wp.array3d[float],
):
    """Columns ``begin`` to ``end`` of one sample about the mean, mean + f L (B z), L by its bands."""
    ...


@wp.kernel
def shape_noise_kernel(
    # inputs
    z: wp.array3d[float],  # [E, S, P·nu] standard normals
    shaping: wp.array2d[float],  # [P, n] shaping matrix B without its columns of zeros
    white: int,  # whether B is the identity
    constant: float,  # share of the samples whose noise is the same at every knot
    nu: int,
    first: int,  # row e·S + s of thread 0
    lanes: int,  # threads that share the knots of a sample
    # outputs
    noise: wp.array3d[float],  # [E, S, P·nu]
):
    """One thread: shaped noise B z of one sample at some knots.

    Constant samples are spread evenly over all; theirs is the noise of the first knot.
    """
    thread, lane = wp.tid()
    e = (first + thread) // z.shape[1]
    s = (first + thread) % z.shape[1]
    knots = noise.shape[2] // nu
    begin = lane * knots // lanes
    end = (lane + 1) * knots // lanes

    if wp.floor(float(s + 1) * constant) != wp.floor(float(s) * constant):
        for p in range(begin, end):
            for u in range(nu):
                noise[e, s, p * nu + u] = z[e, s, u]
    elif white != 0:
        for c in range(begin * nu, end * nu):
            noise[e, s, c] = z[e, s, c]
    else:
        shape_row(z, shaping, e, s, nu, begin, end, noise)


@wp.kernel
def perturb_knots_kernel(
    # inputs
    mean: wp.array2d[float],  # [E, P·nu]
    sigma: wp.array2d[float],  # [E, P·nu] standard deviation, in control units
    bands: wp.array3d[float],  # [E, nu, P·nu] of a full covariance's Cholesky factor: L[u, u-lag] at column p·nu + u
    full: int,  # whether the covariance is L Lᵀ at every knot, instead of σ²
    schedule: wp.array2d[float],  # [iteration, P·nu] factor on the deviation
    iteration: int,
    noise: wp.array3d[float],  # [E, S, P·nu] shaped, of unit variance
    fixed: wp.array3d[float],  # [F, E, P·nu] samples that are not drawn
    fixed_rows: int,  # F
    mean_row: int,  # whether sample 0 is the mean, or else drawn
    lower: wp.array[float],  # [P·nu]
    upper: wp.array[float],  # [P·nu]
    first: int,  # row e·S + s of thread 0
    lanes: int,  # threads that share the columns of a sample
    # outputs
    drawn: wp.array3d[float],  # [E, S, P·nu] before the limits
    knots: wp.array3d[float],  # [E, S, P·nu] within the limits
):
    """One thread: some columns of one sample, mean + σ ⊙ (B z) as drawn, and within the limits, as it is rolled out.

    Sample 0 may be the mean itself, samples 1 to F are fixed ones. With a full covariance the noise of a knot is L z.
    """
    thread, lane = wp.tid()
    e = (first + thread) // knots.shape[1]
    s = (first + thread) % knots.shape[1]
    begin = lane * knots.shape[2] // lanes
    end = (lane + 1) * knots.shape[2] // lanes

    if s == 0 and mean_row != 0:
        for c in range(begin, end):
            drawn[e, s, c] = wp.clamp(mean[e, c], lower[c], upper[c])
            knots[e, s, c] = drawn[e, s, c]
    elif s > 0 and s <= fixed_rows:
        for c in range(begin, end):
            drawn[e, s, c] = wp.clamp(fixed[s - 1, e, c], lower[c], upper[c])
            knots[e, s, c] = drawn[e, s, c]
    elif full != 0:
        perturb_row_together(mean, bands, schedule, iteration, noise, lower, upper, e, s, begin, end, drawn, knots)
    else:
        perturb_row(mean, sigma, schedule, iteration, noise, lower, upper, e, s, begin, end, drawn, knots)


@wp.kernel
def proposed_rows_kernel(
    # inputs
    proposed: wp.array2d[float],  # [E, n·P·nu]
    null: wp.array2d[float],  # [E, nu] control that asks for nothing
    # outputs
    rows: wp.array4d[float],  # [n, E, P, nu]
):
    """One thread: one knot of a sample that was proposed on the host; where there is none, it asks for nothing."""
    i, e, p = wp.tid()
    nu = null.shape[1]
    for u in range(nu):
        value = proposed[e, (i * rows.shape[2] + p) * nu + u]
        rows[i, e, p, u] = wp.where(wp.isfinite(value), value, null[e, u])


@wp.kernel
def null_rows_kernel(
    # inputs
    null: wp.array2d[float],  # [E, nu] control that asks for nothing
    # outputs
    rows: wp.array4d[float],  # [n, E, P, nu]
):
    """One thread: one knot of a null particle, which asks for nothing all along (Bhardwaj et al. 2021)."""
    i, e, p = wp.tid()
    for u in range(null.shape[1]):
        rows[i, e, p, u] = null[e, u]
