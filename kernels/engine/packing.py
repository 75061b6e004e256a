# SPDX-License-Identifier: Apache-2.0
"""Exchange between host and device in a plan: one block of numbers in, one block out."""

import warp as wp

wp.set_module_options({"enable_backward": False})

REPORT = wp.constant(7)
"""Numbers of a report's row besides command, knots and terms: β, η, cost and sample of the best, diverged, overflow."""


@wp.kernel
def unpack_kernel(
    # inputs
    packed: wp.array2d[float],  # [E, 3 + nq + nv + na + 7 nm + proposed + 7 poses + scalars + terms]
    # outputs
    observed: wp.array[int],  # [E] whether there is an observation to plan from
    elapsed: wp.array[float],  # [E] time since the last plan [s]
    start: wp.array[float],  # [E] time of the observation [s]
    joint_q: wp.array2d[float],  # [E, nq]
    joint_qd: wp.array2d[float],  # [E, nv]
    act: wp.array2d[float],  # [E, na]
    mocap: wp.array2d[float],  # [E, 7 nm]
    proposed: wp.array2d[float],  # [E, n·P·nu] knots of samples that are proposed
    pose: wp.array2d[float],  # [E, 7 poses] of the task
    scalar: wp.array2d[float],  # [E, scalars] of the task
    weight: wp.array2d[float],  # [E, terms] of the task
):
    """One thread: one number of the observed state and the task of one environment.

    It is read once: on a GPU it comes from the host's memory, and all threads wait at once.
    """
    e, i = wp.tid()
    value = packed[e, i]
    if i == 0:
        observed[e] = int(value)
    if i == 1:
        elapsed[e] = value
    if i == 2:
        start[e] = value
    at = i - 3
    if at >= 0 and at < joint_q.shape[1]:
        joint_q[e, at] = value
    at -= joint_q.shape[1]
    if at >= 0 and at < joint_qd.shape[1]:
        joint_qd[e, at] = value
    at -= joint_qd.shape[1]
    if at >= 0 and at < act.shape[1]:
        act[e, at] = value
    at -= act.shape[1]
    if at >= 0 and at < mocap.shape[1]:
        mocap[e, at] = value
    at -= mocap.shape[1]
    if at >= 0 and at < proposed.shape[1]:
        proposed[e, at] = value
    at -= proposed.shape[1]
    if at >= 0 and at < pose.shape[1]:
        pose[e, at] = value
    at -= pose.shape[1]
    if at >= 0 and at < scalar.shape[1]:
        scalar[e, at] = value
    at -= scalar.shape[1]
    if at >= 0:
        weight[e, at] = value


@wp.kernel
def survey_kernel(
    # inputs
    cost: wp.array2d[float],  # [E, S]
    diverged: wp.array[int],  # [W]
    overflow: wp.array[int],  # [W] capacity bits
    # outputs
    best: wp.array[int],  # [E]
    best_cost: wp.array[float],  # [E] +inf when every sample diverged
    failures: wp.array2d[int],  # [E, 2] diverged worlds, all worlds' capacity bits together
):
    """One block: one environment's best sample, of equally good ones the first, 0 when all diverged; its failures."""
    e, lane = wp.tid()
    samples = cost.shape[1]
    worlds = diverged.shape[0] // cost.shape[0]

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

    lost = int(0)
    bits = int(0)
    for w in range(e * worlds + lane, (e + 1) * worlds, wp.block_dim()):
        lost += wp.where(diverged[w] != 0, 1, 0)
        bits = bits | overflow[w]
    lost = wp.tile_extract(wp.tile_sum(wp.tile(lost)), 0)
    together = int(0)
    if wp.tile_extract(wp.tile_max(wp.tile(bits)), 0) != 0:
        for bit in range(31):
            together = together | (wp.tile_extract(wp.tile_max(wp.tile((bits >> bit) & 1)), 0) << bit)

    if lane == 0:
        best[e] = wp.where(winner == samples, 0, winner)
        best_cost[e] = least
        failures[e, 0] = lost
        failures[e, 1] = together


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
    lanes: int,  # threads that share a row
    # outputs
    report: wp.array2d[float],  # [E, nu + REPORT + terms + P nu + 1]
):
    """One thread: some of an environment's row: command, REPORT numbers, terms, knots, time from first knot to present.

    Capacity bits come in two halves of 16 bits, which a float holds exactly.
    """
    e, lane = wp.tid()
    nu = command.shape[1]
    for i in range(lane, nu, lanes):
        report[e, i] = command[e, i]
    if lane == 0:
        report[e, nu] = beta[e]
        report[e, nu + 1] = eta[e]
        report[e, nu + 2] = best_cost[e]
        report[e, nu + 3] = float(best[e])
        report[e, nu + 4] = float(failures[e, 0])
        report[e, nu + 5] = float(failures[e, 1] & 0xFFFF)
        report[e, nu + 6] = float((failures[e, 1] >> 16) & 0xFFFF)
    at = nu + REPORT
    for i in range(lane, term_cost.shape[1], lanes):
        report[e, at + i] = term_cost[e, i]
    at += term_cost.shape[1]
    columns = knots.shape[1] * nu
    for i in range(lane, columns, lanes):
        report[e, at + i] = knots[e, i // nu, i % nu]
    if lane == 0:
        report[e, at + columns] = offset[e]
