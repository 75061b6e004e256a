# SPDX-License-Identifier: Apache-2.0
"""Rollouts without physics: joints follow controls, bodies follow joints (Bhardwaj et al. 2021, Eqs. 7, 8)."""

import warp as wp

from ..geometry.kinematics import JointTable, forward_kinematics
from ..planning.splines import Spline, evaluate_spline, knot_place, locate

wp.set_module_options({"enable_backward": False})

VELOCITY = wp.constant(0)
POSITION = wp.constant(1)
ACCELERATION = wp.constant(2)

TAPS = wp.constant(4)
"""Most knots that a control depends on."""


@wp.struct
class Drives:
    """What controls do to joints."""

    matrix: wp.array2d[float]  # [nd, nu] target = matrix · control
    mode: wp.array[int]  # [nd] VELOCITY, POSITION or ACCELERATION
    dof: wp.array[int]  # [nd] joint velocity
    coord: wp.array[int]  # [nd] joint coordinate


@wp.struct
class KinematicWork:
    """What rollouts start from, follow, and leave behind, for kernels that judge on the way."""

    knots: wp.array4d[float]  # [E, S, P, nu]
    tap: wp.array3d[int]  # [E, T, TAPS] knots that a step's control depends on
    share: wp.array3d[float]  # [E, T, TAPS] how much of each
    lower: wp.array[float]  # [nu]
    upper: wp.array[float]  # [nu]
    joint_q: wp.array2d[float]  # [E, nq] observed
    joint_qd: wp.array2d[float]  # [E, nv] observed
    mocap: wp.array2d[wp.transform]  # [E, nm] observed
    dt: wp.array[float]  # [T] [s]
    step_weight: wp.array[float]  # [T]
    weight: wp.array2d[float]  # [E, term]
    total: wp.array2d[float]  # [term, W] cost of each term over the horizon
    control: wp.array3d[float]  # [T, W, nu], of rollouts that are recorded
    record_q: wp.array3d[float]  # [T+1, W, nq]
    record_qd: wp.array3d[float]  # [T+1, W, nv]
    record_body_q: wp.array3d[wp.transform]  # [T+1, W, nb]
    record_body_qd: wp.array3d[wp.spatial_vector]  # [T+1, W, nb]


@wp.kernel
def taps_kernel(
    # inputs
    unit: wp.array3d[float],  # [P, P, 1] one knot after the other is one, all others zero
    s: Spline,
    step_time: wp.array[float],  # [T] time of each step after the present [s]
    step_place: wp.array[float],  # [T] the same in knots, for evenly spaced ones
    offset: wp.array[float],  # [E] time from the first knot to the present [s]
    # outputs
    tap: wp.array3d[int],  # [E, T, TAPS]
    share: wp.array3d[float],  # [E, T, TAPS]
):
    """One thread: the knots that the control of one step depends on, and how much; a spline is linear in its knots."""
    e, t = wp.tid()
    place = step_place[t] + offset[e] / s.knot_dt
    if s.even == 0:
        place = knot_place(s, step_time[t] + offset[e])
    at = locate(unit.shape[0], s.kind, place)
    for k in range(TAPS):
        # knots next to the first one of its segment, which comes first: with one tap it is the only one
        knot = at.i + k
        if k == TAPS - 1:
            knot = at.i - 1
        tap[e, t, k] = wp.clamp(knot, 0, unit.shape[0] - 1)
        share[e, t, k] = 0.0
        if knot >= 0 and knot < unit.shape[0]:
            share[e, t, k] = evaluate_spline(unit[knot], s, s.kind, 0, at)


@wp.func
def follow(
    drives: Drives,
    control: wp.array3d[float],
    t: int,
    w: int,
    dt: float,
    joint_q: wp.array3d[float],
    joint_qd: wp.array3d[float],
):
    """Joints of world w after control t, from slice t to slice t + 1 (Eq. 7: semi-implicit)."""
    for i in range(joint_q.shape[2]):
        joint_q[t + 1, w, i] = joint_q[t, w, i]
    for i in range(joint_qd.shape[2]):
        joint_qd[t + 1, w, i] = 0.0
    for d in range(drives.dof.shape[0]):
        target = float(0.0)
        for u in range(control.shape[2]):
            target += drives.matrix[d, u] * control[t, w, u]
        i = drives.dof[d]
        c = drives.coord[d]
        speed = float(target)
        if drives.mode[d] == ACCELERATION:
            speed = joint_qd[t, w, i] + target * dt
        if drives.mode[d] == POSITION:
            speed = (target - joint_q[t, w, c]) / dt
        joint_qd[t + 1, w, i] = speed
        joint_q[t + 1, w, c] = joint_q[t, w, c] + speed * dt


@wp.kernel
def kinematic_rollout_kernel(
    # inputs
    table: JointTable,
    drives: Drives,
    k: KinematicWork,
    samples: int,
    world: wp.array[int],  # [n] worlds to record
    # outputs
    control: wp.array3d[float],  # [T, n, nu]
    joint_q: wp.array3d[float],  # [T+1, n, nq]
    joint_qd: wp.array3d[float],  # [T+1, n, nv]
    body_q: wp.array3d[wp.transform],  # [T+1, n, nb]
    body_qd: wp.array3d[wp.spatial_vector],  # [T+1, n, nb]
):
    """One thread: the whole rollout of one world."""
    w = wp.tid()
    e = world[w] // samples
    sample = world[w] % samples
    for i in range(joint_q.shape[2]):
        joint_q[0, w, i] = k.joint_q[e, i]
    for i in range(joint_qd.shape[2]):
        joint_qd[0, w, i] = k.joint_qd[e, i]
    for m in range(k.mocap.shape[1]):
        table.mocap_pose[w, m] = k.mocap[e, m]
    for t in range(control.shape[0]):
        for u in range(control.shape[2]):
            value = float(0.0)
            for tap in range(TAPS):
                value += k.share[e, t, tap] * k.knots[e, sample, k.tap[e, t, tap], u]
            control[t, w, u] = wp.clamp(value, k.lower[u], k.upper[u])
        follow(drives, control, t, w, k.dt[t], joint_q, joint_qd)
    for t in range(joint_q.shape[0]):
        forward_kinematics(table, t, w, joint_q, joint_qd, body_q, body_qd)


@wp.kernel
def finish_kernel(
    # inputs
    total: wp.array2d[float],  # [term, W] of terms that were summed on the way
    stage_cost: wp.array3d[float],  # [term, T, W] of terms that were not, or empty
    staged: wp.array[int],  # [n] which they are
    step_weight: wp.array[float],  # [T]
    observed: wp.array[int],  # [E] whether there is an observation to plan from
    first: int,  # world of thread 0
    # outputs
    term_total: wp.array2d[float],  # [term, W] of all terms
    diverged: wp.array[int],  # [W]
    cost: wp.array2d[float],  # [E, S] +inf where it is not finite
):
    """One thread: one sample's cost, S = Σ_t γ^t Σ_i c_i."""
    w = first + wp.tid()
    for n in range(staged.shape[0]):
        i = staged[n]
        part = float(0.0)
        for t in range(stage_cost.shape[1]):
            part += step_weight[t] * stage_cost[i, t, w]
        term_total[i, w] = part
    sum = float(0.0)
    for i in range(total.shape[0]):
        sum += total[i, w]
    finite = wp.isfinite(sum)
    diverged[w] = wp.where(finite, 0, 1)
    e = w // cost.shape[1]
    cost[e, w % cost.shape[1]] = wp.where(finite and observed[e] != 0, sum, wp.inf)


@wp.kernel
def explain_total_kernel(
    # inputs
    total: wp.array2d[float],  # [term, W]
    sample: wp.array[int],  # [E]
    samples: int,
    # outputs
    term_cost: wp.array2d[float],  # [E, term]
):
    """One thread: what one term added to the cost of one environment's sample."""
    e, i = wp.tid()
    term_cost[e, i] = total[i, e * samples + sample[e]]
