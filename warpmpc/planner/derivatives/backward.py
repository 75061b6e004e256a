# SPDX-License-Identifier: Apache-2.0
"""The backward pass of iLQG: feedback policies of quadratic models, with limits of the controls."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ...kernels.planner.riccati import backward_kernel, scratch_size
from ...physics.runtime.launch import capturing

if TYPE_CHECKING:
    from .expansion import Linear, Quadratic


@dataclass(frozen=True)
class Backward:
    """Result of the backward pass."""

    change: np.ndarray
    """k ``[E, T, nu]``."""
    gain: np.ndarray
    """K ``[E, T, nu, n]``; zero for controls at their limits."""
    failed: np.ndarray
    """True where ∂²Q/∂u² is not positive definite with the damping ``[E]``."""


def backward(
    model: Linear, cost: Quadratic, room: tuple[np.ndarray, np.ndarray], scale: np.ndarray, damping: np.ndarray
) -> Backward:
    """Solve the quadratic models of all environments from their ends to their starts.

    Tassa, Erez and Todorov 2012, Eq. 6 to 11, and with limits Tassa, Mansard and Todorov 2014. Controls are taken in
    units of ``scale``, so that one damping suits all of them.

    Args:
        model: Derivatives of the steps.
        cost: Expansion of what they cost.
        room: How far each control may go down and up ``[E, T, nu]`` each.
        scale: Unit of each control ``[nu]``.
        damping: μ of each environment, added to the diagonal of ∂²Q/∂u² ``[E]``.
    """
    given = [model.a, model.b * scale, cost.x, cost.u * scale, cost.xx, cost.ux * scale[:, None]]
    given += [cost.uu * np.outer(scale, scale), *(limit / scale for limit in room), damping]
    envs, steps, n, nu = given[1].shape
    scratch = np.empty((envs, scratch_size(n, nu)))
    out = [np.empty(shape) for shape in ((envs, steps, nu), (envs, steps, nu, n))]
    failed = np.zeros(envs, dtype=np.int32)

    def seen(array: np.ndarray) -> wp.array:
        kind = int if array.dtype == np.int32 else wp.float64
        return wp.array(np.ascontiguousarray(array), dtype=kind, device="cpu", copy=False)

    with capturing:
        outputs = [seen(array) for array in (scratch, *out, failed)]
        wp.launch(backward_kernel, envs, [seen(array) for array in given], outputs, device="cpu")
    change, gain = out
    return Backward(change * scale, gain * scale[:, None], failed != 0)
