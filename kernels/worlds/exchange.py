# SPDX-License-Identifier: Apache-2.0
"""What crosses between host and device in a plan: one block of numbers in, one block out."""

import warp as wp

wp.set_module_options({"enable_backward": False})

REPORT = wp.constant(7)
"""Numbers of a report's row besides command, knots and terms: β, η, cost and sample of the best, diverged, overflow."""


@wp.func
def load_transform(packed: wp.array2d[float], e: int, i: int) -> wp.transform:
    """Read a pose (x, y, z, qx, qy, qz, qw)."""
    return wp.transform(
        wp.vec3(packed[e, i], packed[e, i + 1], packed[e, i + 2]),
        wp.quat(packed[e, i + 3], packed[e, i + 4], packed[e, i + 5], packed[e, i + 6]),
    )


@wp.kernel
def unpack_kernel(
    # inputs
    packed: wp.array2d[float],  # [E, 3 + nq + nv + na + 7 nm + 7 poses + scalars + terms]
    # outputs
    observed: wp.array[int],  # [E] whether there is an observation to plan from
    elapsed: wp.array[float],  # [E] time since the last plan [s]
    start: wp.array[float],  # [E] time of the observation [s]
    joint_q: wp.array2d[float],  # [E, nq]
    joint_qd: wp.array2d[float],  # [E, nv]
    act: wp.array2d[float],  # [E, na]
    mocap: wp.array2d[wp.transform],  # [E, nm]
    pose: wp.array2d[wp.transform],  # [E, poses] of the task
    scalar: wp.array2d[float],  # [E, scalars] of the task
    weight: wp.array2d[float],  # [E, terms] of the task
):
    """One thread: the observed state and the task of one environment."""
    e = wp.tid()
    observed[e] = int(packed[e, 0])
    elapsed[e] = packed[e, 1]
    start[e] = packed[e, 2]
    at = int(3)
    for i in range(joint_q.shape[1]):
        joint_q[e, i] = packed[e, at + i]
    at += joint_q.shape[1]
    for i in range(joint_qd.shape[1]):
        joint_qd[e, i] = packed[e, at + i]
    at += joint_qd.shape[1]
    for i in range(act.shape[1]):
        act[e, i] = packed[e, at + i]
    at += act.shape[1]
    for i in range(mocap.shape[1]):
        mocap[e, i] = load_transform(packed, e, at + 7 * i)
    at += 7 * mocap.shape[1]
    for i in range(pose.shape[1]):
        pose[e, i] = load_transform(packed, e, at + 7 * i)
    at += 7 * pose.shape[1]
    for i in range(scalar.shape[1]):
        scalar[e, i] = packed[e, at + i]
    at += scalar.shape[1]
    for i in range(weight.shape[1]):
        weight[e, i] = packed[e, at + i]


@wp.kernel
def best_sample_kernel(
    # inputs
    cost: wp.array2d[float],  # [E, S]
    # outputs
    best: wp.array[int],  # [E]
    best_cost: wp.array[float],  # [E] +inf when every sample diverged
):
    """Find one environment's best sample, one block each; of equally good ones the first, 0 when all diverged."""
    e, lane = wp.tid()
    samples = cost.shape[1]

    least = float(wp.inf)
    for s in range(lane, samples, wp.block_dim()):
        if wp.isfinite(cost[e, s]):
            least = wp.min(least, cost[e, s])
    least = wp.tile_extract(wp.tile_min(wp.tile(least)), 0)
    candidate = int(samples)
    for s in range(lane, samples, wp.block_dim()):
        if wp.isfinite(cost[e, s]) and cost[e, s] == least:
            candidate = wp.min(candidate, s)
    winner = wp.tile_extract(wp.tile_min(wp.tile(candidate)), 0)

    if lane == 0:
        best[e] = wp.where(winner == samples, 0, winner)
        best_cost[e] = least


@wp.kernel
def count_failures_kernel(
    # inputs
    diverged: wp.array[int],  # [W]
    overflow: wp.array[int],  # [W] capacity bits
    rollouts: int,  # per environment
    # outputs
    failures: wp.array2d[int],  # [E, 2] diverged worlds, all worlds' capacity bits together; zero before
):
    """One thread: add one world's failures to its environment's."""
    w = wp.tid()
    e = w // rollouts
    if diverged[w] != 0:
        wp.atomic_add(failures, e, 0, 1)
    if overflow[w] != 0:
        wp.atomic_or(failures, e, 1, overflow[w])


@wp.kernel
def report_kernel(
    # inputs
    command: wp.array2d[float],  # [E, nu]
    beta: wp.array[float],  # [E]
    eta: wp.array[float],  # [E]
    best: wp.array[int],  # [E]
    best_cost: wp.array[float],  # [E]
    failures: wp.array2d[int],  # [E, 2]
    term_cost: wp.array2d[float],  # [E, terms]
    knots: wp.array3d[float],  # [E, P, nu]
    offset: wp.array[float],  # [E]
    # outputs
    report: wp.array2d[float],  # [E, nu + REPORT + terms + P nu + 1]
):
    """One thread: one environment's row: command, REPORT numbers, terms, knots, time from first knot to present.

    Capacity bits come in two halves of 16 bits, which a float holds exactly.
    """
    e = wp.tid()
    nu = command.shape[1]
    for i in range(nu):
        report[e, i] = command[e, i]
    report[e, nu] = beta[e]
    report[e, nu + 1] = eta[e]
    report[e, nu + 2] = best_cost[e]
    report[e, nu + 3] = float(best[e])
    report[e, nu + 4] = float(failures[e, 0])
    report[e, nu + 5] = float(failures[e, 1] & 0xFFFF)
    report[e, nu + 6] = float((failures[e, 1] >> 16) & 0xFFFF)
    at = nu + REPORT
    for i in range(term_cost.shape[1]):
        report[e, at + i] = term_cost[e, i]
    at += term_cost.shape[1]
    for p in range(knots.shape[1]):
        for i in range(nu):
            report[e, at + p * nu + i] = knots[e, p, i]
    report[e, at + knots.shape[1] * nu] = offset[e]
