# SPDX-License-Identifier: Apache-2.0
"""Factors by which cost terms become the cost of a rollout: weight, terminal factor and discount, as data.

J = Σ_t γ_t ρ(Σ_i τ_it w_i n_i; R) with ρ the risk of ``planner.stage_risk``. τ is zero where a term does not count:
terminal terms take the place of the last stage's cost (Bhardwaj et al. 2021, Eq. 2). Kernels, the source of launches
and derivatives all read the same arrays.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..kernels.planning.costs import CostWeights
from ..scene.schema import When

if TYPE_CHECKING:
    from ..scene.schema import Cost


def term_factors(costs: Sequence[Cost]) -> np.ndarray:
    """Factors on what terms cost before the last step of a horizon, and at it ``[term, 2]``."""
    ends = [cost.when is When.TERMINAL for cost in costs]
    replaced = any(end and cost.weight for end, cost in zip(ends, costs, strict=True))
    counted = [(not end, end or not replaced) for end in ends]
    return np.array([(a, b * cost.terminal) for cost, (a, b) in zip(costs, counted, strict=True)]).reshape(-1, 2)


def cost_weights(weight: wp.array, factors: np.ndarray, discount: np.ndarray) -> CostWeights:
    """Factors of terms at every step, on the device of their weights.

    Args:
        weight: Weights ``[E, term]``; the array itself is read, since the task may change them between plans.
        factors: Factors of :func:`term_factors` ``[term, 2]``.
        discount: γ_t ``[T]``.
    """
    each = np.tile(factors[:, 0], (len(discount), 1))
    each[-1] = factors[:, 1]
    out = CostWeights()
    out.term = weight
    out.terminal = wp.array(each, dtype=float, device=weight.device)
    out.discount = wp.array(discount, dtype=float, device=weight.device)
    return out


def stage_weights(weights: CostWeights) -> np.ndarray:
    """Factor τ_it w_i on what each term costs at each step ``[E, T, term]``."""
    return weights.term.numpy()[:, None].astype(float) * weights.terminal.numpy()
