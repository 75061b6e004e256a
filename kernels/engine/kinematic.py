# SPDX-License-Identifier: Apache-2.0
"""Rollouts without physics: joints follow controls, bodies follow joints (Bhardwaj et al. 2021, Eqs. 7, 8)."""

import warp as wp

from ..geometry.kinematics import JointTable, forward_kinematics
from .launch import TAPS

wp.set_module_options({"enable_backward": False})

VELOCITY = wp.constant(0)
POSITION = wp.constant(1)
ACCELERATION = wp.constant(2)


@wp.struct
class Drives:
    """Effects of controls on joints."""

    matrix: wp.array2d[float]  # [nd, nu] target = matrix · control
    mode: wp.array[int]  # [nd] VELOCITY, POSITION or ACCELERATION
    dof: wp.array[int]  # [nd] joint velocity
    coord: wp.array[int]  # [nd] joint coordinate


@wp.struct
class KinematicWork:
    """Inputs and outputs of rollouts, for launches that evaluate terms, too."""

    knots: wp.array4d[float]  # [E, S, P, nu]
    tap: wp.array3d[int]  # [E, T, TAPS] knots that a step's control depends on
    share: wp.array3d[float]  # [E, T, TAPS] how much of each
    lower: wp.array[float]  # [nu]
    upper: wp.array[float]  # [nu]
    joint_q: wp.array2d[float]  # [E, nq] observed
    joint_qd: wp.array2d[float]  # [E, nv] observed
    mocap: wp.array2d[wp.transform]  # [E, nm] observed
    control: wp.array3d[float]  # [T, W, nu], of rollouts that are recorded
    record_q: wp.array3d[float]  # [T+1, W, nq]
    record_qd: wp.array3d[float]  # [T+1, W, nv]
    record_body_q: wp.array3d[wp.transform]  # [T+1, W, nb]
    record_body_qd: wp.array3d[wp.spatial_vector]  # [T+1, W, nb]


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
    dt: wp.array[float],  # [T] [s]
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
        follow(drives, control, t, w, dt[t], joint_q, joint_qd)
    for t in range(joint_q.shape[0]):
        forward_kinematics(table, t, w, joint_q, joint_qd, body_q, body_qd)


@wp.kernel
def kinematic_step_kernel(
    # inputs
    table: JointTable,
    drives: Drives,
    control: wp.array3d[float],  # [T, W, nu] that of step 0 is followed
    dt: float,  # [s]
    first: int,  # world of thread 0
    # outputs
    joint_q: wp.array3d[float],  # [T+1, W, nq] slice 1 is written
    joint_qd: wp.array3d[float],  # [T+1, W, nv]
    body_q: wp.array3d[wp.transform],  # [T+1, W, nb]
    body_qd: wp.array3d[wp.spatial_vector],  # [T+1, W, nb]
):
    """One thread: one step of one world."""
    w = first + wp.tid()
    follow(drives, control, 0, w, dt, joint_q, joint_qd)
    forward_kinematics(table, 1, w, joint_q, joint_qd, body_q, body_qd)
