# SPDX-License-Identifier: Apache-2.0
"""Random physical properties: scale factors and offsets, one row per draw.

A draw depends on the seed, its row and ``first_item`` + its column only: more rows or more items leave it as it was.
Quantities that must vary independently (mass, friction, size) take different seeds or ranges of items.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

# P(|z| < 3) of a standard normal: the range of erf within three standard deviations
ERF_THREE_SIGMA = wp.constant(0.9973002)


@wp.kernel
def uniform_scale_kernel(
    # inputs
    spread: wp.array[float],  # [items] half-width p, a fraction of nominal, below 1
    seed: int,
    first_item: int,
    nominal_first: int,
    # outputs
    scale: wp.array2d[float],  # [N, items] uniform in [1 - p, 1 + p]
):
    """Draw the factor of one item in one draw; with ``nominal_first`` draw 0 is nominal, factor 1."""
    n, i = wp.tid()

    row = wp.rand_init(seed, n)
    state = wp.rand_init(wp.randi(row), first_item + i)
    factor = 1.0 + spread[i] * wp.randf(state, -1.0, 1.0)
    scale[n, i] = wp.where(n == 0 and nominal_first != 0, 1.0, factor)


@wp.kernel
def normal_offset_kernel(
    # inputs
    sigma: wp.array[float],  # [items] standard deviation before truncation [m]
    seed: int,
    first_item: int,
    nominal_first: int,
    # outputs
    offset: wp.array3d[float],  # [N, items, 3] zero mean, within ±3σ [m]
):
    """Draw the offset of one item in one draw, each axis a Gaussian truncated at 3σ by its inverse distribution."""
    n, i = wp.tid()

    row = wp.rand_init(seed, n)
    state = wp.rand_init(wp.randi(row), first_item + i)
    for axis in range(3):
        z = wp.sqrt(2.0) * wp.erfinv(ERF_THREE_SIGMA * wp.randf(state, -1.0, 1.0))
        offset[n, i, axis] = wp.where(n == 0 and nominal_first != 0, 0.0, sigma[i] * z)
