# SPDX-License-Identifier: Apache-2.0
"""The kernel that rolls out and judges in one launch, made for a scene's robot and its cost terms."""

from typing import Any

import warp as wp

from ..bake.number import WIDE
from ..cost.kernel import JudgeCode
from ..kernels.terms.view import StepView
from ..kernels.worlds.judging import TermSums
from ..kernels.worlds.kinematic import KinematicWork
from .judging_kernel import judging_functions

WARP = wp.constant(32)


def make_kernel(source: str, params: Any, lanes: int, judge: JudgeCode | None) -> wp.Kernel:
    """Compile baked source into a kernel.

    Args:
        source: Body of the native function.
        params: ``wp.struct`` of the parameters of all terms.
        lanes: Samples that a thread takes on the CPU; on a GPU a warp takes one.
        judge: Code of the terms that are no part of the source, if there are any.
    """
    options = {"cpu_compiler_flags": (wp.config.cpu_compiler_flags or "") + WIDE} if lanes == 16 else {}

    @wp.func_native(source)
    def rollout(s: StepView, p: params, k: KinematicWork, costs: TermSums, group: int): ...

    if judge is None:

        @wp.kernel(module="unique", enable_backward=False, module_options=options)
        def kinematic_kernel(
            # inputs
            s: StepView,
            p: params,
            first: int,  # group of thread 0
            # outputs
            k: KinematicWork,
            costs: TermSums,
        ):
            """One thread: a group of samples from start to end; on a GPU one step of one sample."""
            rollout(s, p, k, costs, first + wp.tid())

        return kinematic_kernel

    own_params = judge.params
    judge_world, judge_group = judging_functions(judge, lanes)

    @wp.kernel(module="unique", enable_backward=False, module_options=options)
    def judging_kernel(
        # inputs
        s: StepView,
        p: params,
        own: own_params,
        first: int,  # group of thread 0
        groups: int,  # of an environment on the CPU, 0 on a GPU
        samples: int,
        # outputs
        k: KinematicWork,
        costs: TermSums,
        cost: wp.array3d[float],  # [term, T, W]
    ):
        """One thread: as above, and then the terms that read the record."""
        group = first + wp.tid()
        rollout(s, p, k, costs, group)
        if groups > 0:
            judge_group(s, own, group, groups, samples, costs.weight, cost)
        else:
            judge_world(s, own, group // WARP, samples, group % WARP, WARP, costs.weight, cost)

    return judging_kernel
