# SPDX-License-Identifier: Apache-2.0
"""The backward pass of iLQG under limits of the controls (Tassa, Erez and Todorov 2012; box-DDP 2014)."""

import warp as wp

wp.set_module_options({"enable_backward": False})

_BACKWARD = """
    // rows of scratch memory
    double* vx = (double*)scratch;          // [n] gradient of the value
    double* vxx = vx + n;                   // [n, n] its Hessian
    double* va = vxx + n * n;               // [n, n] V A
    double* vb = va + n * n;                // [n, m] V B
    double* qxx = vb + n * m;               // [n, n]
    double* qux = qxx + n * n;              // [m, n]
    double* quu = qux + m * n;              // [m, m]
    double* damped = quu + m * m;           // [m, m]
    double* factor = damped + m * m;        // [m, m] Cholesky factor of the free part
    double* qx = factor + m * m;            // [n]
    double* qu = qx + n;                    // [m]
    double* x = qu + m;                     // [m] change of the controls
    double* slope = x + m;                  // [m]
    double* step = slope + m;               // [m]
    double* other = step + m;               // [m]
    double* big = other + m;                // [m, n] gain
    double* row = big + m * n;              // [m, n]
    int* free = (int*)(row + m * n);        // [m] controls that no limit holds, in order
    for (int i = 0; i < n + n * n; ++i) vx[i] = 0.0;
    for (int i = 0; i < m; ++i) x[i] = 0.0;
    for (int t = steps - 1; t >= 0; --t) {
        const double* a = (const double*)A + (size_t)t * n * n;
        const double* b = (const double*)B + (size_t)t * n * m;
        const double* low = (const double*)lower + t * m;
        const double* high = (const double*)upper + t * m;
        for (int i = 0; i < n; ++i) {
            for (int j = 0; j < n; ++j) va[i * n + j] = 0.0;
            for (int j = 0; j < m; ++j) vb[i * m + j] = 0.0;
            for (int k = 0; k < n; ++k) {
                const double v = vxx[i * n + k];
                for (int j = 0; j < n; ++j) va[i * n + j] += v * a[k * n + j];
                for (int j = 0; j < m; ++j) vb[i * m + j] += v * b[k * m + j];
            }
        }
        for (int i = 0; i < n; ++i) qx[i] = ((const double*)lx)[t * n + i];
        for (int i = 0; i < m; ++i) qu[i] = ((const double*)lu)[t * m + i];
        for (int i = 0; i < n * n; ++i) qxx[i] = ((const double*)lxx)[(size_t)t * n * n + i];
        for (int i = 0; i < m * n; ++i) qux[i] = ((const double*)lux)[(size_t)t * m * n + i];
        for (int i = 0; i < m * m; ++i) quu[i] = ((const double*)luu)[(size_t)t * m * m + i];
        for (int k = 0; k < n; ++k) {
            for (int i = 0; i < n; ++i) {
                const double v = a[k * n + i];
                qx[i] += v * vx[k];
                for (int j = 0; j < n; ++j) qxx[i * n + j] += v * va[k * n + j];
            }
            for (int i = 0; i < m; ++i) {
                const double v = b[k * m + i];
                qu[i] += v * vx[k];
                for (int j = 0; j < n; ++j) qux[i * n + j] += v * va[k * n + j];
                for (int j = 0; j < m; ++j) quu[i * m + j] += v * vb[k * m + j];
            }
        }
        for (int i = 0; i < m * m; ++i) damped[i] = quu[i];
        for (int i = 0; i < m; ++i) damped[i * m + i] += damping;
        // least of x' D x / 2 + q' x between the limits, by a projected Newton method that starts from the later step's
        for (int i = 0; i < m; ++i) x[i] = x[i] < low[i] ? low[i] : (x[i] > high[i] ? high[i] : x[i]);
        int count = 0;
        for (int trial = 0; trial < 50; ++trial) {
            double value = 0.0;
            count = 0;
            for (int i = 0; i < m; ++i) {
                slope[i] = 0.0;
                for (int j = 0; j < m; ++j) slope[i] += damped[i * m + j] * x[j];
                value += x[i] * (0.5 * slope[i] + qu[i]);
                slope[i] += qu[i];
                if (!((x[i] <= low[i] && slope[i] > 0.0) || (x[i] >= high[i] && slope[i] < 0.0))) free[count++] = i;
            }
            for (int i = 0; i < count; ++i) {
                for (int j = 0; j <= i; ++j) {
                    double sum = damped[free[i] * m + free[j]];
                    for (int k = 0; k < j; ++k) sum -= factor[i * m + k] * factor[j * m + k];
                    if (i != j) factor[i * m + j] = sum / factor[j * m + j];
                    else if (sum > 0.0) factor[i * m + i] = sqrt(sum);
                    else { *(int*)failed = 1; return; }
                }
            }
            for (int i = 0; i < m; ++i) step[i] = 0.0;
            for (int i = 0; i < count; ++i) {
                double sum = -slope[free[i]];
                for (int k = 0; k < i; ++k) sum -= factor[i * m + k] * other[k];
                other[i] = sum / factor[i * m + i];
            }
            double longest = 0.0, promise = 0.0;
            for (int i = count - 1; i >= 0; --i) {
                double sum = other[i];
                for (int k = i + 1; k < count; ++k) sum -= factor[k * m + i] * step[free[k]];
                step[free[i]] = sum / factor[i * m + i];
                const double size = step[free[i]] < 0.0 ? -step[free[i]] : step[free[i]];
                longest = size > longest ? size : longest;
            }
            if (longest < 1e-9) break;
            for (double size = 1.0; size > 1e-10; size *= 0.5) {
                double found = 0.0;
                promise = 0.0;
                for (int i = 0; i < m; ++i) {
                    const double y = x[i] + size * step[i];
                    other[i] = y < low[i] ? low[i] : (y > high[i] ? high[i] : y);
                    promise += slope[i] * (other[i] - x[i]);
                }
                for (int i = 0; i < m; ++i) {
                    double sum = 0.0;
                    for (int j = 0; j < m; ++j) sum += damped[i * m + j] * other[j];
                    found += other[i] * (0.5 * sum + qu[i]);
                }
                if (found - value <= 0.1 * promise) break;  // Armijo: a tenth of what the slope promises
            }
            for (int i = 0; i < m; ++i) x[i] = other[i];
        }
        // gains of the controls that are free: - D^-1 Qux
        for (int i = 0; i < m * n; ++i) big[i] = 0.0;
        for (int i = 0; i < count; ++i) {
            for (int j = 0; j < n; ++j) row[i * n + j] = -qux[free[i] * n + j];
            for (int k = 0; k < i; ++k)
                for (int j = 0; j < n; ++j) row[i * n + j] -= factor[i * m + k] * row[k * n + j];
            for (int j = 0; j < n; ++j) row[i * n + j] /= factor[i * m + i];
        }
        for (int i = count - 1; i >= 0; --i) {
            double* own = big + free[i] * n;
            for (int j = 0; j < n; ++j) own[j] = row[i * n + j];
            for (int k = i + 1; k < count; ++k)
                for (int j = 0; j < n; ++j) own[j] -= factor[k * m + i] * big[free[k] * n + j];
            for (int j = 0; j < n; ++j) own[j] /= factor[i * m + i];
        }
        for (int i = 0; i < m; ++i) {
            ((double*)change)[t * m + i] = x[i];
            slope[i] = 0.0;
            for (int j = 0; j < m; ++j) slope[i] += quu[i * m + j] * x[j];
        }
        for (int i = 0; i < m * n; ++i) ((double*)gain)[(size_t)t * m * n + i] = big[i];
        // value: Vx = Qx + K'(Quu k + Qu) + Qux' k, Vxx = Qxx + K' Quu K + K' Qux + Qux' K
        for (int i = 0; i < n; ++i) vx[i] = qx[i];
        for (int i = 0; i < n * n; ++i) vxx[i] = qxx[i];
        for (int i = 0; i < m; ++i) {
            for (int j = 0; j < n; ++j) row[i * n + j] = qux[i * n + j];
            for (int k = 0; k < m; ++k) {
                const double v = quu[i * m + k];
                for (int j = 0; j < n; ++j) row[i * n + j] += v * big[k * n + j];
            }
            const double force = slope[i] + qu[i];
            for (int j = 0; j < n; ++j) vx[j] += big[i * n + j] * force + qux[i * n + j] * x[i];
        }
        for (int i = 0; i < m; ++i) {
            for (int r = 0; r < n; ++r) {
                const double k = big[i * n + r], q = qux[i * n + r];
                for (int j = 0; j < n; ++j) vxx[r * n + j] += k * row[i * n + j] + q * big[i * n + j];
            }
        }
        for (int i = 0; i < n; ++i) {
            for (int j = 0; j < i; ++j) {
                const double mean = 0.5 * (vxx[i * n + j] + vxx[j * n + i]);
                vxx[i * n + j] = mean;
                vxx[j * n + i] = mean;
            }
        }
    }
"""


@wp.func_native(_BACKWARD)
def solve_backward(
    A: wp.uint64,
    B: wp.uint64,
    lx: wp.uint64,
    lu: wp.uint64,
    lxx: wp.uint64,
    lux: wp.uint64,
    luu: wp.uint64,
    lower: wp.uint64,
    upper: wp.uint64,
    damping: wp.float64,
    scratch: wp.uint64,
    change: wp.uint64,
    gain: wp.uint64,
    failed: wp.uint64,
    steps: int,
    n: int,
    m: int,
):
    """Solve one quadratic model from its end to its start; :func:`backward_kernel` says what is where."""
    ...


@wp.kernel
def backward_kernel(
    # inputs
    a: wp.array4d[wp.float64],  # [E, T, n, n] ∂x'/∂x
    b: wp.array4d[wp.float64],  # [E, T, n, m] ∂x'/∂u
    lx: wp.array3d[wp.float64],  # [E, T, n] expansion of the costs
    lu: wp.array3d[wp.float64],  # [E, T, m]
    lxx: wp.array4d[wp.float64],  # [E, T, n, n]
    lux: wp.array4d[wp.float64],  # [E, T, m, n]
    luu: wp.array4d[wp.float64],  # [E, T, m, m]
    lower: wp.array3d[wp.float64],  # [E, T, m] how far each control may change
    upper: wp.array3d[wp.float64],  # [E, T, m]
    damping: wp.array[wp.float64],  # [E] added to the diagonal of ∂²Q/∂u²
    scratch: wp.array2d[wp.float64],  # [E, ...] of scratch_size(n, m) numbers
    # outputs
    change: wp.array3d[wp.float64],  # [E, T, m] k
    gain: wp.array4d[wp.float64],  # [E, T, m, n] K, zero for controls at their limits
    failed: wp.array[int],  # [E] whether a ∂²Q/∂u² is not positive definite
):
    """One thread: the backward pass of one environment; for the CPU alone."""
    e = wp.tid()
    steps = a.shape[1]
    n = a.shape[2]
    m = b.shape[3]
    eight = wp.uint64(8)
    own = wp.uint64(e) * wp.uint64(steps) * eight
    wide = wp.uint64(n)
    narrow = wp.uint64(m)
    failed[e] = 0
    solve_backward(
        a.ptr + own * wide * wide,
        b.ptr + own * wide * narrow,
        lx.ptr + own * wide,
        lu.ptr + own * narrow,
        lxx.ptr + own * wide * wide,
        lux.ptr + own * narrow * wide,
        luu.ptr + own * narrow * narrow,
        lower.ptr + own * narrow,
        upper.ptr + own * narrow,
        damping[e],
        scratch.ptr + wp.uint64(e) * wp.uint64(scratch.shape[1]) * eight,
        change.ptr + own * narrow,
        gain.ptr + own * narrow * wide,
        failed.ptr + wp.uint64(e) * wp.uint64(4),
        steps,
        n,
        m,
    )


def scratch_size(n: int, m: int) -> int:
    """Numbers of scratch memory that a backward pass takes."""
    return n + 3 * n * n + n * m + m * n + 3 * m * m + n + 5 * m + 2 * m * n + m
