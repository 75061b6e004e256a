# SPDX-License-Identifier: Apache-2.0
"""Factors by which cost terms become the cost of a rollout: weight, terminal factor and discount, as data.

J = Σ_t γ_t ρ(Σ_i τ_it w_i n_i; R) with ρ the risk of ``planner.stage_risk``. Kernels, the source of launches and
derivatives all read the same arrays.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..kernels.planning.costs import CostWeights

if TYPE_CHECKING:
    from ..task.observed import ObservedState
    from .stack import CostStack


def cost_weights(stack: CostStack, state: ObservedState, discount: np.ndarray) -> CostWeights:
    """Factors of a stack's terms at every step, on its device.

    Args:
        stack: The terms.
        state: Weights of the terms, whose array is shared: the task may change them between plans.
        discount: γ_t ``[T]``.
    """
    terminal = np.ones((len(discount), len(stack.terms)))
    terminal[-1] = stack.terminal
    out = CostWeights()
    out.term = state.weight
    out.terminal = wp.array(terminal, dtype=float, device=stack.device)
    out.discount = wp.array(discount, dtype=float, device=stack.device)
    return out


def stage_weights(weights: CostWeights) -> np.ndarray:
    """Factor τ_it w_i on what each term costs at each step ``[E, T, term]``."""
    return weights.term.numpy()[:, None].astype(float) * weights.terminal.numpy()
