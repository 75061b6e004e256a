# SPDX-License-Identifier: Apache-2.0
"""The kernel that evaluates one cost term over all rollouts.

Annotations are not postponed here: Warp reads the parameter struct from the closure.
"""

from typing import Any

import warp as wp

from ..kernels.terms.view import StepView


def stage_cost_kernel(function: wp.Function, params: Any) -> wp.Kernel:
    """Build the kernel of one cost term.

    Args:
        function: The term's Warp function.
        params: Its parameter struct.
    """

    @wp.kernel(module="unique", enable_backward=False)
    def stage_cost(
        # inputs
        view: StepView,
        p: params,
        weight: wp.array[float],  # [term]
        term: int,
        rollouts: int,  # per environment
        # outputs
        cost: wp.array3d[float],  # [term, T, W]
    ):
        """One thread: one term's weighted cost at one step of one world."""
        t, w = wp.tid()
        s = view
        s.t = t + 1
        s.w = w
        s.e = w // rollouts
        cost[term, t, w] = weight[term] * function(s, p)

    return stage_cost
