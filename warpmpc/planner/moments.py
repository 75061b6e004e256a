# SPDX-License-Identifier: Apache-2.0
"""Weighted moments of the samples, on any device."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from ..kernels.planning.moments import (
    keep_best_kernel,
    spread_kernel,
    sweep_mean_kernel,
    sweep_spread_kernel,
    update_mean_kernel,
)
from ..launch import Launcher
from .weighting import block_dim

if TYPE_CHECKING:
    from collections.abc import Sequence


class SampleMoments:
    """Mean and spread of weighted samples: in blocks on a GPU, in one sweep through memory on the CPU.

    Args:
        knots: Samples ``[E, S, P, nu]``.
        drawn: The same before the limits; without limits when left out.
        weight: Their weights ``[E, S]``.
        limits: Lower and upper limits of the columns, ``[P·nu]`` each; none when left out.
        variance: Relative variance of their noise, 0 where they are not drawn, ``[S]``; 1 when left out.
        full: Whether the spread has products of different controls.
    """

    products: wp.array3d[float]
    """Sums over the samples, Σ w (θ-μ)_c (θ-μ)_{c+lag} of the columns c = p·nu + u, ``[E, lags, P·nu]``."""
    total: wp.array[float]
    """Sums of the weights that belong to them, ``[E]``."""

    def __init__(
        self,
        knots: wp.array,
        weight: wp.array,
        *,
        drawn: wp.array | None = None,
        limits: Sequence[wp.array] = (),
        variance: wp.array | None = None,
        full: bool = False,
    ):
        envs, samples, count, nu = knots.shape
        self.device = knots.device
        self._launch, self._columns, self._block_dim = Launcher(self.device), count * nu, block_dim(samples)
        none = [wp.full(count * nu, bound, dtype=float, device=self.device) for bound in (-wp.inf, wp.inf)]
        self._limits = limits or none
        self._variance = wp.full(samples, 1.0, dtype=float, device=self.device) if variance is None else variance
        self._knots, self._weight = knots.reshape((envs, samples, count * nu)), weight
        self._drawn = self._knots if drawn is None else drawn.reshape(self._knots.shape)
        self._sums = wp.zeros((envs, 3, count * nu), dtype=float, device=self.device)
        self._deviation = wp.zeros((envs, 2, count * nu), dtype=float, device=self.device)
        self.products = wp.zeros((envs, nu if full else 1, count * nu), dtype=float, device=self.device)
        self.total = wp.zeros(envs, dtype=float, device=self.device)

    def _flat(self, plan: wp.array) -> wp.array:
        return plan.reshape((plan.shape[0], self._columns))

    def move_mean(self, mean: wp.array, alpha: float, *, tried: int | None = None) -> None:
        """Move a mean ``[E, P, nu]`` towards the weighted samples by step size α; capture-safe.

        Args:
            tried: Samples that were tried, the first ones; all when left out.
        """
        tried = self._weight.shape[1] if tried is None else tried
        envs, inputs = mean.shape[0], [self._drawn, self._weight, self._variance, tried, *self._limits, alpha]
        if self.device.is_cpu:
            self._launch(sweep_mean_kernel, envs, inputs, [self._sums, self._flat(mean)])
        else:
            outputs = [self._flat(mean)]
            self._launch(update_mean_kernel, (envs, self._columns), inputs, outputs, block_dim=self._block_dim)

    def spread_about(self, mean: wp.array) -> None:
        """Write :attr:`products` and :attr:`total` about a mean ``[E, P, nu]``; capture-safe."""
        inputs, outputs = [self._knots, self._weight, self._flat(mean)], [self.products, self.total]
        if self.device.is_cpu:
            self._launch(sweep_spread_kernel, mean.shape[0], inputs, [self._deviation, *outputs])
        else:
            self._launch(spread_kernel, self.products.shape, inputs, outputs, block_dim=self._block_dim)

    def keep_best(self, cost: wp.array, best: wp.array) -> None:
        """Write the n samples of lowest cost ``[E, S]``, as far as they are finite, into ``best [n, E, P, nu]``.

        Capture-safe.
        """
        inputs, outputs = [cost, self._knots], [best.reshape((*best.shape[:2], self._columns))]
        self._launch(keep_best_kernel, cost.shape[0], inputs, outputs, block_dim=self._block_dim)
