# SPDX-License-Identifier: Apache-2.0
"""The kernel that rolls worlds out in one launch, made for a scene's model."""

import warp as wp

from ...bake.number import WIDE


@wp.struct
class FusedWork:
    """What rollouts start from and follow, and what they write down."""

    initial: wp.array2d[wp.float64]  # [W, nstate] MuJoCo's time, qpos, qvel and act
    mocap: wp.array2d[wp.transform]  # [W, nm]
    movable: wp.array2d[wp.transform]  # [W, n] obstacles that move with the task
    control: wp.array3d[float]  # [T, W, nu]
    substeps: wp.array[int]  # [T] physics steps in each control step
    given: wp.array[float]  # numbers of the model that are no part of the source
    par: wp.array2d[float]  # [P, W] what differs between worlds
    joint_q: wp.array3d[float]  # [T+1, W, nq] slices 1..T are written
    joint_qd: wp.array3d[float]  # [T+1, W, nv]
    act: wp.array3d[float]  # [T+1, W, na]
    body_q: wp.array3d[wp.transform]  # [T+1, W, nb]
    body_qd: wp.array3d[wp.spatial_vector]  # [T+1, W, nb]
    force: wp.array3d[wp.vec3]  # [T, W, pair] [N] on the pair's first side
    diverged: wp.array[int]  # [W] nonzero where the physics failed
    overflow: wp.array[int]  # [W] nonzero where contacts were lost


CONTRACT = " -ffp-contract=fast"
"""Compiler flag for products and sums in one instruction: a fifth less time in `mobile_pick`."""
WARP = 32
"""Lanes of a warp."""


def make_kernel(source: str, lanes: int, threads: int) -> wp.Kernel:
    """Compile baked source into a kernel.

    Args:
        source: Body of the native function.
        lanes: Worlds that a thread takes on the CPU; on a GPU a thread takes one.
        threads: Threads that share a world on a GPU, else 1.
    """
    sharing = wp.constant(threads)
    wide = WIDE if lanes == 16 else ""
    flags = (wp.config.cpu_compiler_flags or "") + wide + CONTRACT
    options = {"cpu_compiler_flags": flags, "fast_math": True}

    @wp.func_native(source)
    def rollout(k: FusedWork, group: int, first: int, end: int): ...

    @wp.kernel(module="unique", enable_backward=False, module_options=options)
    def fused_kernel(
        # inputs and outputs
        k: FusedWork,
        first: int,  # world of thread 0
        end: int,  # one past the last world
    ):
        """One thread: all steps of as many worlds as a number has lanes; on a GPU of one, or a lane's part of it."""
        rollout(k, wp.tid() // sharing, first, end)

    return fused_kernel
