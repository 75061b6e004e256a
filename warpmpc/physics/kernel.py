# SPDX-License-Identifier: Apache-2.0
"""The kernel that rolls worlds out, made for one model."""

from __future__ import annotations

import warp as wp

from ..bake.simd import WIDE

CONTRACT = " -ffp-contract=fast"
"""Compiler flag for products and sums in one instruction: a fifth less time in `mobile_pick`."""
WARP = 32
"""Lanes of a warp."""


@wp.struct
class RolloutWork:
    """Arrays that rollouts start from and follow, and those that they fill."""

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
    steps: wp.array[wp.uint64]  # [CALLS] on a CPU, addresses of what moves worlds on (:class:`~.steps.Steps`)
    given: wp.array[float]  # numbers of the model that are no part of the source
    par: wp.array2d[float]  # [P, W] what differs between worlds
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


def options(lanes: int) -> dict[str, object]:
    """Options of the module of a kernel whose threads take a number of worlds each on a CPU."""
    flags = (wp.config.cpu_compiler_flags or "") + (WIDE if lanes == 16 else "") + CONTRACT
    return {"cpu_compiler_flags": flags, "fast_math": True}


def make_kernel(source: str, lanes: int, threads: int) -> wp.Kernel:
    """Compile the source of rollouts into a kernel.

    Args:
        source: Body of the native function (:class:`~.source.RolloutSource`).
        lanes: Worlds that a thread takes on a CPU; on a GPU a thread takes one.
        threads: Threads that share a world on a GPU, else 1.
    """
    sharing = wp.constant(threads)

    @wp.func_native(source)
    def rollout_plain(k: RolloutWork, group: int): ...

    @wp.kernel(module="unique", enable_backward=False, module_options=options(lanes))
    def rollout_kernel(
        # inputs
        first: int,  # group of thread 0
        # inputs and outputs
        k: RolloutWork,
    ):
        """One thread: all steps of as many worlds as a number has lanes; on a GPU of one, or its part of one."""
        rollout_plain(k, first + wp.tid() // sharing)

    return rollout_kernel
