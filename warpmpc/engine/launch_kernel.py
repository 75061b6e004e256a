# SPDX-License-Identifier: Apache-2.0
"""The kernel that rolls worlds out and evaluates cost terms in one launch, made for a scene's model and its terms."""

from collections.abc import Mapping
from typing import Any

import warp as wp

from ..cost.kernel import EvaluationCode
from ..kernels.cost.view import StepView
from ..kernels.engine.launch import TermSums
from ..kernels.planner.costs import CostWeights

RECORDS_ALONE = -1
"""Groups of an environment for launches that evaluate nothing they recorded."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
__syncwarp();
#endif
""")
def wait_for_lanes():
    """Make what one lane of a warp wrote visible to the others."""
    ...


def make_kernel(
    source: str, work: Any, params: Any, code: EvaluationCode, *, lanes: int, sharing: int, options: Mapping[str, Any]
) -> wp.Kernel:
    """Compile the source of rollouts with cost terms into a kernel.

    Args:
        source: Body of the native function, which sums the terms that are part of it.
        work: ``wp.struct`` of what rollouts start from and fill.
        params: ``wp.struct`` of the parameters of the terms in the source.
        code: Terms that read what the launch records.
        lanes: Worlds that a thread takes on the CPU.
        sharing: Threads that share a world on a GPU, else 1.
        options: Options of the kernel's module.
    """
    threads = wp.constant(sharing)
    evaluate_step, own_params, advance_step = code.step, code.params, code.advance
    advances = wp.constant(code.advances)

    @wp.func_native(source)
    def rollout(s: StepView, p: params, k: work, sums: TermSums, group: int): ...

    @wp.func(module="unique")
    def evaluate_world(
        view: StepView,
        own: own_params,
        w: int,
        rollouts: int,  # per environment
        lane: int,
        sharing: int,  # lanes that divide the steps among them
        weights: CostWeights,
        cost: wp.array3d[float],  # [term, T, W]
    ):
        """One world: first the numbers that terms carry along, by one lane, then the terms, by all."""
        s = view
        s.w = w
        s.e = w // rollouts
        steps = cost.shape[1]
        if advances:
            if lane == 0:
                for t in range(steps + 1):
                    s.t = t
                    advance_step(s, own)
            if sharing > 1:
                wait_for_lanes()
        for t in range(lane, steps, sharing):
            s.t = t + 1
            evaluate_step(s, own, weights, cost)

    @wp.kernel(module="unique", enable_backward=False, module_options=options)
    def launch_kernel(
        # inputs
        s: StepView,
        p: params,
        own: own_params,
        first: int,  # group of thread 0
        groups: int,  # of an environment on the CPU, 0 on a GPU, RECORDS_ALONE to evaluate nothing that is recorded
        rollouts: int,  # worlds of an environment
        # inputs and outputs
        k: work,
        sums: TermSums,
        cost: wp.array3d[float],  # [term, T, W] of the terms that read the record
    ):
        """One thread: a group of worlds from start to end, or its part of one, then the terms that read the record."""
        group = first + wp.tid() // threads
        rollout(s, p, k, sums, group)
        if groups == 0:
            evaluate_world(s, own, group, rollouts, wp.tid() % threads, threads, sums.weights, cost)
        elif groups > 0:
            begin = (group // groups) * rollouts
            start = (group % groups) * lanes
            for i in range(start, wp.min(start + lanes, rollouts)):
                evaluate_world(s, own, begin + i, rollouts, 0, 1, sums.weights, cost)

    return launch_kernel
