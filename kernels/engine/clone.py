# SPDX-License-Identifier: Apache-2.0
"""Clone the observed state into all worlds, and move states and controls between Newton's and MuJoCo's conventions."""

import warp as wp

from ..geometry.kinematics import BALL, DISTANCE, FREE, JointTable, forward_kinematics

wp.set_module_options({"enable_backward": False})


@wp.func
def store_vec3(out: wp.array2d[wp.float64], w: int, i: int, v: wp.vec3):
    """Write three numbers of a MuJoCo state row."""
    for k in range(3):
        out[w, i + k] = wp.float64(v[k])


@wp.func
def store_quat(out: wp.array2d[wp.float64], w: int, i: int, q: wp.quat):
    """Write a quaternion in MuJoCo's order (w, x, y, z)."""
    out[w, i] = wp.float64(q[3])
    for k in range(3):
        out[w, i + 1 + k] = wp.float64(q[k])


@wp.func
def load_vec3(state: wp.array3d[wp.float64], w: int, n: int, i: int) -> wp.vec3:
    """Read three numbers of a MuJoCo state row."""
    return wp.vec3(float(state[w, n, i]), float(state[w, n, i + 1]), float(state[w, n, i + 2]))


@wp.func
def load_quat(state: wp.array3d[wp.float64], w: int, n: int, i: int) -> wp.quat:
    """Read a quaternion stored as (w, x, y, z)."""
    return wp.quat(
        float(state[w, n, i + 1]), float(state[w, n, i + 2]), float(state[w, n, i + 3]), float(state[w, n, i])
    )


@wp.func
def write_mujoco_state(
    table: JointTable,
    w: int,
    nq_mujoco: int,
    joint_q: wp.array3d[float],
    joint_qd: wp.array3d[float],
    out: wp.array2d[wp.float64],
):
    """Write joint_q[0, w], joint_qd[0, w] as MuJoCo's (time, qpos, qvel) into out[w]; time starts at zero."""
    for i in range(out.shape[1]):
        out[w, i] = wp.float64(0.0)
    for j in range(table.type.shape[0]):
        if table.mujoco_q[j] < 0:
            continue
        q_out = 1 + table.mujoco_q[j]
        v_out = 1 + nq_mujoco + table.mujoco_qd[j]
        q = table.q_start[j]
        v = table.qd_start[j]
        kind = table.type[j]
        if kind == FREE or kind == DISTANCE:
            local = wp.transform(
                wp.vec3(joint_q[0, w, q], joint_q[0, w, q + 1], joint_q[0, w, q + 2]),
                wp.quat(joint_q[0, w, q + 3], joint_q[0, w, q + 4], joint_q[0, w, q + 5], joint_q[0, w, q + 6]),
            )
            pose = table.pose_parent[j] * local * wp.transform_inverse(table.pose_child[j])
            rotation = wp.transform_get_rotation(pose)
            v_com = wp.transform_vector(
                table.pose_parent[j], wp.vec3(joint_qd[0, w, v], joint_qd[0, w, v + 1], joint_qd[0, w, v + 2])
            )
            omega = wp.transform_vector(
                table.pose_parent[j], wp.vec3(joint_qd[0, w, v + 3], joint_qd[0, w, v + 4], joint_qd[0, w, v + 5])
            )
            arm = wp.quat_rotate(rotation, table.body_com[table.child[j]])
            store_vec3(out, w, q_out, wp.transform_get_translation(pose))
            store_quat(out, w, q_out + 3, rotation)
            store_vec3(out, w, v_out, v_com - wp.cross(omega, arm))
            store_vec3(out, w, v_out + 3, wp.quat_rotate_inv(rotation, omega))
        elif kind == BALL:
            anchor = wp.transform_get_rotation(table.pose_child[j])
            r = wp.quat(joint_q[0, w, q], joint_q[0, w, q + 1], joint_q[0, w, q + 2], joint_q[0, w, q + 3])
            omega = wp.vec3(joint_qd[0, w, v], joint_qd[0, w, v + 1], joint_qd[0, w, v + 2])
            store_quat(out, w, q_out, anchor * r * wp.quat_inverse(anchor))
            store_vec3(out, w, v_out, wp.quat_rotate(anchor * wp.quat_inverse(r), omega))
        else:
            for k in range(table.linear_axes[j] + table.angular_axes[j]):
                out[w, q_out + k] = wp.float64(joint_q[0, w, q + k])
                out[w, v_out + k] = wp.float64(joint_qd[0, w, v + k])


@wp.func
def read_mujoco_state(
    table: JointTable,
    w: int,
    n: int,
    t: int,
    nq_mujoco: int,
    state: wp.array3d[wp.float64],
    joint_q: wp.array3d[float],
    joint_qd: wp.array3d[float],
):
    """Write MuJoCo's state[w, n] as Newton's joint_q[t, w], joint_qd[t, w]."""
    for j in range(table.type.shape[0]):
        if table.mujoco_q[j] < 0:
            continue
        q_in = 1 + table.mujoco_q[j]
        v_in = 1 + nq_mujoco + table.mujoco_qd[j]
        q = table.q_start[j]
        v = table.qd_start[j]
        kind = table.type[j]
        if kind == FREE or kind == DISTANCE:
            pose = wp.transform(load_vec3(state, w, n, q_in), load_quat(state, w, n, q_in + 3))
            rotation = wp.transform_get_rotation(pose)
            omega = wp.quat_rotate(rotation, load_vec3(state, w, n, v_in + 3))
            arm = wp.quat_rotate(rotation, table.body_com[table.child[j]])
            parent = wp.transform_inverse(table.pose_parent[j])
            v_com = wp.transform_vector(parent, load_vec3(state, w, n, v_in) + wp.cross(omega, arm))
            omega = wp.transform_vector(parent, omega)
            local = parent * pose * table.pose_child[j]
            p = wp.transform_get_translation(local)
            r = wp.transform_get_rotation(local)
            for k in range(3):
                joint_q[t, w, q + k] = p[k]
                joint_qd[t, w, v + k] = v_com[k]
                joint_qd[t, w, v + 3 + k] = omega[k]
            for k in range(4):
                joint_q[t, w, q + 3 + k] = r[k]
        elif kind == BALL:
            anchor = wp.transform_get_rotation(table.pose_child[j])
            r = wp.quat_inverse(anchor) * load_quat(state, w, n, q_in) * anchor
            omega = wp.quat_rotate(r * wp.quat_inverse(anchor), load_vec3(state, w, n, v_in))
            for k in range(4):
                joint_q[t, w, q + k] = r[k]
            for k in range(3):
                joint_qd[t, w, v + k] = omega[k]
        else:
            for k in range(table.linear_axes[j] + table.angular_axes[j]):
                joint_q[t, w, q + k] = float(state[w, n, q_in + k])
                joint_qd[t, w, v + k] = float(state[w, n, v_in + k])


@wp.kernel
def clone_state_kernel(
    # inputs
    table: JointTable,
    observed_q: wp.array2d[float],  # [E, nq]
    observed_qd: wp.array2d[float],  # [E, nv]
    rollouts: int,  # K = S·D worlds per environment
    first: int,  # world of thread 0
    # outputs
    joint_q: wp.array3d[float],  # [T+1, W, nq] slice 0 is written
    joint_qd: wp.array3d[float],  # [T+1, W, nv]
    body_q: wp.array3d[wp.transform],  # [T+1, W, nb]
    body_qd: wp.array3d[wp.spatial_vector],  # [T+1, W, nb]
):
    """One thread: the observed state of an environment becomes the start of one world's rollout."""
    w = first + wp.tid()
    e = w // rollouts
    for i in range(observed_q.shape[1]):
        joint_q[0, w, i] = observed_q[e, i]
    for i in range(observed_qd.shape[1]):
        joint_qd[0, w, i] = observed_qd[e, i]
    forward_kinematics(table, 0, w, joint_q, joint_qd, body_q, body_qd)


@wp.kernel
def clone_activation_kernel(
    # inputs
    observed: wp.array2d[float],  # [E, na]
    rollouts: int,  # K = S·D worlds per environment
    first: int,  # world of thread 0
    # outputs
    act: wp.array3d[float],  # [T+1, W, na] slice 0 is written
):
    """One thread: one observed activation becomes the start of one world's rollout."""
    thread, i = wp.tid()
    w = first + thread
    act[0, w, i] = observed[w // rollouts, i]


@wp.kernel
def clone_mocap_kernel(
    # inputs
    observed: wp.array2d[wp.transform],  # [E, nm]
    rollouts: int,  # K = S·D worlds per environment
    first: int,  # world of thread 0
    # outputs
    mocap: wp.array2d[wp.transform],  # [W, nm]
):
    """One thread: where one mocap body of one world is during the rollout."""
    thread, i = wp.tid()
    w = first + thread
    mocap[w, i] = observed[w // rollouts, i]


@wp.kernel
def mujoco_activation_kernel(
    # inputs
    act: wp.array3d[float],  # [T+1, W, na] slice 0 is read
    column: wp.array[int],  # [na] where MuJoCo's state has each activation
    first: int,  # world of thread 0
    # outputs
    state: wp.array2d[wp.float64],  # [W, nstate] MuJoCo's full physics state
):
    """One thread: one activation at the start of one world."""
    thread, i = wp.tid()
    w = first + thread
    state[w, column[i]] = wp.float64(act[0, w, i])


@wp.kernel
def mujoco_mocap_kernel(
    # inputs
    mocap: wp.array2d[wp.transform],  # [W, nm]
    order: wp.array[int],  # [nm] MuJoCo's mocap body of each
    begin: int,  # column of the first mocap body's position
    count: int,  # mocap bodies of the model: the rotations come after all their positions
    first: int,  # world of thread 0
    # outputs
    control: wp.array3d[wp.float64],  # [W, N, n] what a rollout is given at every physics step
):
    """One thread: the pose of one world's mocap bodies at one physics step."""
    thread, n = wp.tid()
    w = first + thread
    for i in range(order.shape[0]):
        p = wp.transform_get_translation(mocap[w, i])
        q = wp.transform_get_rotation(mocap[w, i])
        at = begin + 3 * order[i]
        turned = begin + 3 * count + 4 * order[i]
        for k in range(3):
            control[w, n, at + k] = wp.float64(p[k])
            control[w, n, turned + 1 + k] = wp.float64(q[k])
        control[w, n, turned] = wp.float64(q[3])


@wp.kernel
def mujoco_state_kernel(
    # inputs
    table: JointTable,
    nq_mujoco: int,
    joint_q: wp.array3d[float],  # [T+1, W, nq] slice 0 is read
    joint_qd: wp.array3d[float],  # [T+1, W, nv]
    first: int,  # world of thread 0
    # outputs
    state: wp.array2d[wp.float64],  # [W, nstate] MuJoCo's full physics state
):
    """One thread: the start of one world in MuJoCo's conventions."""
    w = first + wp.tid()
    write_mujoco_state(table, w, nq_mujoco, joint_q, joint_qd, state)


@wp.kernel
def mujoco_control_kernel(
    # inputs
    control: wp.array3d[float],  # [T, W, nu]
    matrix: wp.array2d[float],  # [na, nu] actuator targets per control
    offset: wp.array[float],  # [na]
    span: wp.array2d[int],  # [na, 2] first and one past the last control that an actuator listens to
    step: wp.array[int],  # [N] control step that each physics step belongs to
    first: int,  # world of thread 0
    # outputs
    actuator: wp.array3d[wp.float64],  # [W, N, na]
):
    """One thread: the actuator targets of one world at all physics steps, held over each control step."""
    w = first + wp.tid()
    for n in range(step.shape[0]):
        t = step[n]
        for a in range(matrix.shape[0]):
            if n > 0 and step[wp.max(n - 1, 0)] == t:
                actuator[w, n, a] = actuator[w, n - 1, a]
            else:
                target = offset[a]
                for i in range(span[a, 0], span[a, 1]):
                    target += matrix[a, i] * control[t, w, i]
                actuator[w, n, a] = wp.float64(target)


@wp.kernel
def record_mujoco_kernel(
    # inputs
    table: JointTable,
    nq_mujoco: int,
    end: wp.array[int],  # [T] last physics step of each control step
    state: wp.array3d[wp.float64],  # [W, N, nstate]
    slice: int,  # of the outputs that the first control step fills
    first: int,  # world of thread 0
    lanes: int,  # threads that share the steps of a world
    # outputs
    joint_q: wp.array3d[float],  # [T+1, W, nq]
    joint_qd: wp.array3d[float],  # [T+1, W, nv]
    body_q: wp.array3d[wp.transform],  # [T+1, W, nb]
    body_qd: wp.array3d[wp.spatial_vector],  # [T+1, W, nb]
):
    """One thread: the state of one world after some control steps, with its body poses."""
    lane, thread = wp.tid()
    w = first + thread
    for t in range(lane, end.shape[0], lanes):
        read_mujoco_state(table, w, end[t], slice + t, nq_mujoco, state, joint_q, joint_qd)
        forward_kinematics(table, slice + t, w, joint_q, joint_qd, body_q, body_qd)


@wp.kernel
def gather_kernel(
    # inputs
    source: wp.array3d[wp.float64],  # [W, N, n]
    column: wp.array[int],  # [m] column of the source behind each number, -1 for none
    end: wp.array[int],  # [T] last physics step of each control step
    slice: int,  # of the output that the first control step fills
    first: int,  # world of thread 0
    # outputs
    out: wp.array3d[float],  # [T or T+1, W, m]
):
    """One thread: some columns of one world's record at the end of one control step."""
    t, thread = wp.tid()
    w = first + thread
    for i in range(column.shape[0]):
        if column[i] >= 0:
            out[slice + t, w, i] = float(source[w, end[t], column[i]])


@wp.kernel
def divergence_kernel(
    # inputs
    state: wp.array3d[wp.float64],  # [W, N, nstate]
    duration: wp.float64,  # [s] of the whole rollout
    first: int,  # world of thread 0
    # outputs
    diverged: wp.array[int],  # [W]
):
    """One thread: whether one world blew up. MuJoCo stops such a world early and repeats its last good state."""
    w = first + wp.tid()
    last = state.shape[1] - 1
    bad = int(0)
    # written so that a NaN time counts as bad
    if not (wp.abs(state[w, last, 0] - duration) < wp.float64(1.0e-6) + wp.float64(1.0e-6) * duration):
        bad = 1
    for i in range(state.shape[2]):
        if not wp.isfinite(state[w, last, i]):
            bad = 1
    diverged[w] = bad


VELOCITY_TARGET = wp.constant(0)
POSITION_TARGET = wp.constant(1)
EFFORT = wp.constant(2)


@wp.kernel
def newton_control_kernel(
    # inputs
    control: wp.array3d[float],  # [T, W, nu]
    matrix: wp.array2d[float],  # [na, nu] actuator targets per control
    offset: wp.array[float],  # [na]
    mode: wp.array[int],  # [na]
    dof: wp.array[int],  # [na]
    coord: wp.array[int],  # [na] joint coordinate of the dof
    effort_limit: wp.array[float],  # [na]
    direct: wp.array[int],  # [na] number of MuJoCo's control behind each, -1 for a target of Newton's
    # outputs
    target_q: wp.array3d[float],  # [T, W, nq]
    target_qd: wp.array3d[float],  # [T, W, nv]
    effort: wp.array3d[float],  # [T, W, nv]
    ctrl: wp.array3d[float],  # [T, W, n]
):
    """One thread: the target of one actuator in one world and control step."""
    t, w, a = wp.tid()
    target = offset[a]
    for i in range(matrix.shape[1]):
        target += matrix[a, i] * control[t, w, i]
    if direct[a] >= 0:
        ctrl[t, w, direct[a]] = target
    elif mode[a] == VELOCITY_TARGET:
        target_qd[t, w, dof[a]] = target
    elif mode[a] == POSITION_TARGET:
        target_q[t, w, coord[a]] = target
    else:
        effort[t, w, dof[a]] = wp.clamp(target, -effort_limit[a], effort_limit[a])


@wp.kernel
def finite_state_kernel(
    # inputs
    joint_q: wp.array3d[float],  # [T+1, W, nq]
    joint_qd: wp.array3d[float],  # [T+1, W, nv]
    largest: float,  # speed above which a world counts as blown up
    # outputs
    diverged: wp.array[int],  # [W]
):
    """One thread: whether one world blew up: its last state is not finite, or faster than anything real."""
    w = wp.tid()
    last = joint_q.shape[0] - 1
    bad = int(0)
    for i in range(joint_q.shape[2]):
        if not wp.isfinite(joint_q[last, w, i]):
            bad = 1
    for i in range(joint_qd.shape[2]):
        # written so that a NaN counts as bad
        if not (wp.abs(joint_qd[last, w, i]) < largest):
            bad = 1
    diverged[w] = bad
