# SPDX-License-Identifier: Apache-2.0
"""The kernel that rolls worlds out and judges them in one launch, made for a scene's model and its cost terms."""

from typing import Any

import warp as wp

from ...bake.number import WIDE
from ...cost.kernel import JudgeCode
from ...kernels.terms.view import StepView
from ..judging_kernel import judging_functions


@wp.struct
class FusedWork:
    """What rollouts start from and follow, and what they leave behind."""

    knots: wp.array4d[float]  # [E, S, P, nu]
    tap: wp.array3d[int]  # [E, T, TAPS] knots that a step's control depends on
    share: wp.array3d[float]  # [E, T, TAPS] how much of each
    lower: wp.array[float]  # [nu]
    upper: wp.array[float]  # [nu]
    domains: int  # worlds of a sample
    initial: wp.array2d[wp.float64]  # [W, 1+nq+nv+na] MuJoCo's state with its time, where worlds have their own start
    reached: wp.array2d[wp.float64]  # [W, 1+nq+nv+na] where these worlds end; empty if nobody asks
    joint_q: wp.array2d[float]  # [E, nq] observed
    joint_qd: wp.array2d[float]  # [E, nv] observed
    act: wp.array2d[float]  # [E, na] observed
    mocap: wp.array2d[wp.transform]  # [E, nm] observed
    pose: wp.array2d[wp.transform]  # [E, poses] of the task, those of obstacles that move with it last
    substeps: wp.array[int]  # [T] physics steps in each control step
    given: wp.array[float]  # numbers of the model that are no part of the source
    par: wp.array2d[float]  # [P, W] what differs between worlds
    dt: wp.array[float]  # [T] [s]
    step_weight: wp.array[float]  # [T]
    weight: wp.array2d[float]  # [E, term]
    total: wp.array2d[float]  # [term, W] cost of each term over the horizon
    chosen: wp.array[int]  # [N] worlds to record, those of one environment side by side; empty to evaluate all
    records: int  # whether rollouts are recorded; N is W below where all are
    control: wp.array3d[float]  # [T, N, nu]
    record_q: wp.array3d[float]  # [T+1, N, nq]
    record_qd: wp.array3d[float]  # [T+1, N, nv]
    record_act: wp.array3d[float]  # [T+1, N, na]
    record_body_q: wp.array3d[wp.transform]  # [T+1, N, nb]
    record_body_qd: wp.array3d[wp.spatial_vector]  # [T+1, N, nb]
    force: wp.array3d[wp.vec3]  # [T, N, pair] [N] on the pair's first side
    diverged: wp.array[int]  # [N] nonzero where the physics failed
    overflow: wp.array[int]  # [N] nonzero where contacts were lost


CONTRACT = " -ffp-contract=fast"
"""Compiler flag for products and sums in one instruction: a fifth less time in `mobile_pick`."""
WARP = 32
"""Lanes of a warp."""


def make_kernel(source: str, lanes: int, threads: int, params: Any = None, judge: JudgeCode | None = None) -> wp.Kernel:
    """Compile baked source into a kernel.

    Args:
        source: Body of the native function.
        lanes: Worlds that a thread takes on the CPU; on a GPU a thread takes one.
        threads: Threads that share a world on a GPU, else 1.
        params: ``wp.struct`` of the parameters of all terms; None for rollouts without terms.
        judge: Code of the terms that are no part of the source, if there are any.
    """
    sharing = wp.constant(threads)
    wide = WIDE if lanes == 16 else ""
    flags = (wp.config.cpu_compiler_flags or "") + wide + CONTRACT
    options = {"cpu_compiler_flags": flags, "fast_math": True}

    if params is None:

        @wp.func_native(source)
        def rollout_plain(k: FusedWork, group: int): ...

        @wp.kernel(module="unique", enable_backward=False, module_options=options)
        def fused_kernel(
            # inputs
            first: int,  # group of thread 0
            # inputs and outputs
            k: FusedWork,
        ):
            """One thread: all steps of as many worlds as a number has lanes; on a GPU of one, or its part of one."""
            rollout_plain(k, first + wp.tid() // sharing)

        return fused_kernel

    @wp.func_native(source)
    def rollout(s: StepView, p: params, k: FusedWork, group: int): ...

    if judge is None:

        @wp.kernel(module="unique", enable_backward=False, module_options=options)
        def summing_kernel(
            # inputs
            s: StepView,
            p: params,
            first: int,  # group of thread 0
            # inputs and outputs
            k: FusedWork,
        ):
            """One thread: as above, with what their terms cost."""
            rollout(s, p, k, first + wp.tid() // sharing)

        return summing_kernel

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
        # inputs and outputs
        k: FusedWork,
        cost: wp.array3d[float],  # [term, T, W]
    ):
        """One thread: as above, and then the terms that read the record; on a GPU a lane of a warp has some steps."""
        group = first + wp.tid() // sharing
        rollout(s, p, k, group)
        if k.chosen.shape[0] == 0:
            rollouts = k.knots.shape[1] * k.domains
            if groups > 0:
                judge_group(s, own, group, groups, rollouts, k.weight, cost)
            else:
                judge_world(s, own, group, rollouts, wp.tid() % sharing, sharing, k.weight, cost)

    return judging_kernel
