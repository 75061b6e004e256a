# SPDX-License-Identifier: Apache-2.0
"""The kernel that rolls worlds out and evaluates cost terms in one launch, made for a scene's model and its terms."""

from typing import Any

import warp as wp

from ..cost.kernel import JudgeCode
from ..kernels.terms.view import StepView
from ..kernels.worlds.judging import TermSums
from ..physics.kernel import RolloutWork, options
from .judging_kernel import judging_functions


def make_kernel(source: str, lanes: int, threads: int, params: Any, judge: JudgeCode | None) -> wp.Kernel:
    """Compile the source of rollouts with cost terms into a kernel.

    Args:
        source: Body of the native function.
        lanes: Worlds that a thread takes on the CPU; on a GPU a thread takes one.
        threads: Threads that share a world on a GPU, else 1.
        params: ``wp.struct`` of the parameters of all terms.
        judge: Code of the terms that are no part of the source, if there are any.
    """
    sharing = wp.constant(threads)

    @wp.func_native(source)
    def rollout(s: StepView, p: params, k: RolloutWork, costs: TermSums, group: int): ...

    if judge is None:

        @wp.kernel(module="unique", enable_backward=False, module_options=options(lanes))
        def summing_kernel(
            # inputs
            s: StepView,
            p: params,
            first: int,  # group of thread 0
            # inputs and outputs
            k: RolloutWork,
            costs: TermSums,
        ):
            """One thread: all steps of a group of worlds, with what their terms cost."""
            rollout(s, p, k, costs, first + wp.tid() // sharing)

        return summing_kernel

    own_params = judge.params
    judge_world, judge_group = judging_functions(judge, lanes)

    @wp.kernel(module="unique", enable_backward=False, module_options=options(lanes))
    def judging_kernel(
        # inputs
        s: StepView,
        p: params,
        own: own_params,
        first: int,  # group of thread 0
        groups: int,  # of an environment on the CPU, 0 on a GPU
        # inputs and outputs
        k: RolloutWork,
        costs: TermSums,
        cost: wp.array3d[float],  # [term, T, W]
    ):
        """One thread: as above, and then the terms that read the record; on a GPU a lane of a warp has some steps."""
        group = first + wp.tid() // sharing
        rollout(s, p, k, costs, group)
        if k.chosen.shape[0] == 0:
            rollouts = k.knots.shape[1] * k.domains
            if groups > 0:
                judge_group(s, own, group, groups, rollouts, costs.weight, cost)
            else:
                judge_world(s, own, group, rollouts, wp.tid() % sharing, sharing, costs.weight, cost)

    return judging_kernel
