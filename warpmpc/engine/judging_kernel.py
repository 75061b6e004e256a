# SPDX-License-Identifier: Apache-2.0
"""Functions that judge what the same launch has recorded, for kernels that are made for a scene's cost terms."""

import warp as wp

from ..cost.kernel import JudgeCode
from ..kernels.terms.view import StepView


@wp.func_native("""
#if defined(__CUDA_ARCH__)
__syncwarp();
#endif
""")
def wait_for_lanes():
    """What one lane of a warp wrote is there for the others."""
    ...


def judging_functions(judge: JudgeCode, lanes: int) -> tuple[wp.Function, wp.Function]:
    """Functions that judge one world, a lane of a warp some of its steps, and a group of worlds on a CPU.

    Args:
        judge: Code of the terms.
        lanes: Worlds of a group.
    """
    judge_step, params, advance_step = judge.step, judge.params, judge.advance
    advances = wp.constant(judge.advances)

    @wp.func(module="unique")
    def judge_world(
        view: StepView,
        own: params,
        w: int,
        rollouts: int,  # per environment
        lane: int,
        sharing: int,  # lanes that divide the steps among them
        weight: wp.array2d[float],  # [E, term]
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
            judge_step(s, own, weight, cost)

    @wp.func(module="unique")
    def judge_group(
        view: StepView,
        own: params,
        group: int,
        groups: int,  # of an environment
        rollouts: int,
        weight: wp.array2d[float],
        cost: wp.array3d[float],
    ):
        """The worlds of one group, one after the other."""
        first = (group // groups) * rollouts
        start = (group % groups) * lanes
        for k in range(start, wp.min(start + lanes, rollouts)):
            judge_world(view, own, first + k, rollouts, 0, 1, weight, cost)

    return judge_world, judge_group
