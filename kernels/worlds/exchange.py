# SPDX-License-Identifier: Apache-2.0
"""What crosses between host and device in a plan: one block of numbers in, one block out."""

import warp as wp

wp.set_module_options({"enable_backward": False})

REPORT = wp.constant(6)  # numbers between the command and the terms in a row of the report


@wp.kernel
def unpack_observation_kernel(
    # inputs
    packed: wp.array2d[float],  # [E, nq + nv + 7] joint_q, joint_qd, goal pose
    # outputs
    joint_q: wp.array2d[float],  # [E, nq]
    joint_qd: wp.array2d[float],  # [E, nv]
    goal: wp.array[wp.transform],  # [E]
):
    """One thread: the observed state and goal of one environment."""
    e = wp.tid()
    nq = joint_q.shape[1]
    nv = joint_qd.shape[1]
    for i in range(nq):
        joint_q[e, i] = packed[e, i]
    for i in range(nv):
        joint_qd[e, i] = packed[e, nq + i]
    g = nq + nv
    goal[e] = wp.transform(
        wp.vec3(packed[e, g], packed[e, g + 1], packed[e, g + 2]),
        wp.quat(packed[e, g + 3], packed[e, g + 4], packed[e, g + 5], packed[e, g + 6]),
    )


@wp.kernel
def report_kernel(
    # inputs
    command: wp.array2d[float],  # [E, nu]
    beta: wp.array[float],  # [E]
    eta: wp.array[float],  # [E]
    cost: wp.array2d[float],  # [E, S]
    stage_cost: wp.array3d[float],  # [term, T, W]
    diverged: wp.array[int],  # [W]
    overflow: wp.array[int],  # [W]
    domains: int,
    discount: float,
    # outputs
    report: wp.array2d[float],  # [E, nu + REPORT + terms]
):
    """Pack one environment's row, one block each: command, β, η, best cost and sample, failures, the best's terms.

    The best cost is +inf when every sample diverged; of equally good samples the first counts.
    """
    e, lane = wp.tid()
    samples = cost.shape[1]
    nu = command.shape[1]

    best = float(wp.inf)
    for s in range(lane, samples, wp.block_dim()):
        if wp.isfinite(cost[e, s]):
            best = wp.min(best, cost[e, s])
    best = wp.tile_extract(wp.tile_min(wp.tile(best)), 0)
    candidate = int(samples)
    for s in range(lane, samples, wp.block_dim()):
        if wp.isfinite(cost[e, s]) and cost[e, s] == best:
            candidate = wp.min(candidate, s)
    winner = wp.tile_extract(wp.tile_min(wp.tile(candidate)), 0)
    if winner == samples:
        winner = 0

    bad = int(0)
    bits = int(0)
    rollouts = samples * domains
    for k in range(lane, rollouts, wp.block_dim()):
        w = e * rollouts + k
        if diverged[w] != 0:
            bad += 1
        bits = wp.max(bits, overflow[w])
    bad = wp.tile_extract(wp.tile_sum(wp.tile(bad)), 0)
    bits = wp.tile_extract(wp.tile_max(wp.tile(bits)), 0)

    for i in range(lane, stage_cost.shape[0], wp.block_dim()):
        total = float(0.0)
        factor = float(1.0)
        for t in range(stage_cost.shape[1]):
            total += factor * stage_cost[i, t, e * rollouts + winner * domains]
            factor *= discount
        report[e, nu + REPORT + i] = total
    for i in range(lane, nu, wp.block_dim()):
        report[e, i] = command[e, i]
    if lane == 0:
        report[e, nu] = beta[e]
        report[e, nu + 1] = eta[e]
        report[e, nu + 2] = best
        report[e, nu + 3] = float(winner)
        report[e, nu + 4] = float(bad)
        report[e, nu + 5] = float(bits)
