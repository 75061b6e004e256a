# SPDX-License-Identifier: Apache-2.0
"""Solver contacts → net force per watched pair."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def mujoco_contact_force_kernel(
    # inputs
    sensor: wp.array3d[wp.float64],  # [W, T·substeps, nsensor] net force (x, y, z) per pair, on its second side
    substeps: int,
    # outputs
    force: wp.array3d[wp.vec3],  # [T, W, pair] [N] on the pair's first side, world frame, mean over the physics steps
):
    """One thread: the net contact force of every watched pair in one world and control step."""
    t, w = wp.tid()
    for p in range(force.shape[2]):
        total = wp.vec3(0.0)
        for n in range(t * substeps, (t + 1) * substeps):
            total -= wp.vec3(float(sensor[w, n, 3 * p]), float(sensor[w, n, 3 * p + 1]), float(sensor[w, n, 3 * p + 2]))
        force[t, w, p] = total / float(substeps)
