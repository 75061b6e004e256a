# SPDX-License-Identifier: Apache-2.0
"""The kernel that rolls out and judges in one launch, made for a scene's robot and its cost terms."""

from typing import Any

import warp as wp

from ..bake.number import WIDE
from ..cost.kernel import JudgeCode
from ..kernels.terms.view import StepView
from ..kernels.worlds.kinematic import KinematicWork

WARP = wp.constant(32)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
__syncwarp();
#endif
""")
def wait_for_lanes():
    """What one lane of a warp wrote is there for the others."""
    ...


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
    def rollout(s: StepView, p: params, k: KinematicWork, group: int): ...

    if judge is None:

        @wp.kernel(module="unique", enable_backward=False, module_options=options)
        def kinematic_kernel(
            # inputs
            s: StepView,
            p: params,
            first: int,  # group of thread 0
            # outputs
            k: KinematicWork,
        ):
            """One thread: a group of samples from start to end; on a GPU one step of one sample."""
            rollout(s, p, k, first + wp.tid())

        return kinematic_kernel

    judge_step, judge_params, advance_step = judge.step, judge.params, judge.advance
    advances = wp.constant(judge.advances)

    @wp.kernel(module="unique", enable_backward=False, module_options=options)
    def judging_kernel(
        # inputs
        view: StepView,
        p: params,
        own: judge_params,
        first: int,  # group of thread 0
        groups: int,  # of an environment on the CPU, 0 on a GPU
        samples: int,
        # outputs
        k: KinematicWork,
        cost: wp.array3d[float],  # [term, T, W]
    ):
        """One thread: as above, and then the terms that read the record."""
        group = first + wp.tid()
        rollout(view, p, k, group)
        s = view
        if groups > 0:
            s.e = group // groups
            start = (group % groups) * lanes
            for sample in range(start, wp.min(start + lanes, samples)):
                s.w = s.e * samples + sample
                if advances:
                    for t in range(k.dt.shape[0] + 1):
                        s.t = t
                        advance_step(s, own)
                for t in range(k.dt.shape[0]):
                    s.t = t + 1
                    judge_step(s, own, k.weight, cost)
        else:
            s.w = group // WARP
            s.e = s.w // samples
            if advances:
                if group % WARP == 0:
                    for t in range(k.dt.shape[0] + 1):
                        s.t = t
                        advance_step(s, own)
                wait_for_lanes()
            for t in range(group % WARP, k.dt.shape[0], WARP):
                s.t = t + 1
                judge_step(s, own, k.weight, cost)

    return judging_kernel
