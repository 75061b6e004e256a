# SPDX-License-Identifier: Apache-2.0
"""Factors by which cost terms become the cost of a rollout: weight, terminal factor and discount, as data.

J = Σ_t γ_t ρ(Σ_i τ_it w_i n_i; R) with ρ the risk of ``planner.stage_risk``. Kernels, the source of launches and
derivatives all read the same arrays.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from ..kernels.planning.costs import CostWeights


def cost_weights(weight: wp.array, terminal: Sequence[float], discount: np.ndarray) -> CostWeights:
    """Factors of terms at every step, on the device of their weights.

    Args:
        weight: Weights ``[E, term]``; the array itself is read, since the task may change them between plans.
        terminal: Factor of each term at the last step ``[term]``.
        discount: γ_t ``[T]``.
    """
    each = np.ones((len(discount), len(terminal)))
    each[-1] = terminal
    out = CostWeights()
    out.term = weight
    out.terminal = wp.array(each, dtype=float, device=weight.device)
    out.discount = wp.array(discount, dtype=float, device=weight.device)
    return out


def stage_weights(weights: CostWeights) -> np.ndarray:
    """Factor τ_it w_i on what each term costs at each step ``[E, T, term]``."""
    return weights.term.numpy()[:, None].astype(float) * weights.terminal.numpy()
