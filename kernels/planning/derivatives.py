# SPDX-License-Identifier: Apache-2.0
"""Derivatives of norms, for all residuals of many steps at once."""

import warp as wp

from ..terms.norms import Norm, norm_bend, norm_part, norm_slope, norm_total

wp.set_module_options({"enable_backward": False})


@wp.kernel
def norms_kernel(
    # inputs
    residual: wp.array2d[float],  # [N, R] residuals of all terms, side by side
    first: wp.array[int],  # [term] first of each term's numbers
    count: wp.array[int],  # [term] how many they are
    kind: wp.array[int],  # [term] norm
    p: wp.array[float],  # [term]
    q: wp.array[float],  # [term]
    # outputs
    value: wp.array2d[float],  # [N, term] norm of each term
    slope: wp.array2d[float],  # [N, R] its gradient
    bend: wp.array3d[float],  # [N, R, widest] row i of the Hessian of number i's own term
):
    """One thread: the norm of one term's residual at one step, with its gradient and Hessian."""
    n, i = wp.tid()
    norm = Norm()
    norm.kind = kind[i]
    norm.p = p[i]
    norm.q = q[i]
    start = first[i]
    total = float(0.0)
    for j in range(count[i]):
        total += norm_part(residual[n, start + j], norm)
    value[n, i] = norm_total(total, norm)
    for j in range(count[i]):
        x = residual[n, start + j]
        slope[n, start + j] = norm_slope(x, total, norm)
        for k in range(count[i]):
            bend[n, start + j, k] = norm_bend(x, residual[n, start + k], wp.where(j == k, 1, 0), total, norm)
