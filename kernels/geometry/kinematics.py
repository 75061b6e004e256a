# SPDX-License-Identifier: Apache-2.0
"""Joint motion and forward kinematics of one world, in Newton's conventions."""

import warp as wp

wp.set_module_options({"enable_backward": False})

# newton.JointType, repeated here because kernels import nothing but Warp
PRISMATIC = wp.constant(0)
REVOLUTE = wp.constant(1)
BALL = wp.constant(2)
FIXED = wp.constant(3)
FREE = wp.constant(4)
DISTANCE = wp.constant(5)
D6 = wp.constant(6)


@wp.struct
class JointTable:
    """The joints of one world, parents before children."""

    type: wp.array[int]  # [nj]
    parent: wp.array[int]  # [nj] body or -1
    child: wp.array[int]  # [nj] body
    q_start: wp.array[int]  # [nj] first joint coordinate
    qd_start: wp.array[int]  # [nj] first joint velocity
    linear_axes: wp.array[int]  # [nj]
    angular_axes: wp.array[int]  # [nj]
    pose_parent: wp.array[wp.transform]  # [nj] joint anchor in the parent's frame
    pose_child: wp.array[wp.transform]  # [nj] joint anchor in the child's frame
    centred: wp.array[int]  # [nj] whether that anchor is the child's own frame
    axis: wp.array[wp.vec3]  # [nv]
    body_com: wp.array[wp.vec3]  # [nb]
    mujoco_q: wp.array[int]  # [nj] first qpos of the joint in MuJoCo, -1 where it has none
    mujoco_qd: wp.array[int]  # [nj] first qvel of the joint in MuJoCo
    mocap: wp.array[int]  # [nj] mocap body that the joint would fix to the world, -1 for joints of the physics
    mocap_pose: wp.array2d[wp.transform]  # [W, nm] where each world's mocap bodies are


@wp.func
def joint_transform(table: JointTable, j: int, q: wp.array3d[float], t: int, w: int) -> wp.transform:
    """Transform across joint j at coordinates q[t, w]."""
    i = table.q_start[j]
    kind = table.type[j]
    position = wp.vec3(0.0)
    rotation = wp.quat_identity()
    if kind == FREE or kind == DISTANCE:
        position = wp.vec3(q[t, w, i], q[t, w, i + 1], q[t, w, i + 2])
        rotation = wp.quat(q[t, w, i + 3], q[t, w, i + 4], q[t, w, i + 5], q[t, w, i + 6])
    elif kind == BALL:
        rotation = wp.quat(q[t, w, i], q[t, w, i + 1], q[t, w, i + 2], q[t, w, i + 3])
    else:
        a = table.qd_start[j]
        linear = table.linear_axes[j]
        for k in range(linear):
            position += table.axis[a + k] * q[t, w, i + k]
        # intrinsic order: every axis turns with those before it
        for k in range(table.angular_axes[j]):
            rotation = rotation * wp.quat_from_axis_angle(table.axis[a + linear + k], q[t, w, i + linear + k])
    return wp.transform(position, rotation)


@wp.func
def joint_twist(
    table: JointTable, j: int, q: wp.array3d[float], qd: wp.array3d[float], t: int, w: int
) -> wp.spatial_vector:
    """Linear and angular velocity across joint j in its parent anchor frame (free joints: of the centre of mass)."""
    i = table.qd_start[j]
    kind = table.type[j]
    v = wp.vec3(0.0)
    omega = wp.vec3(0.0)
    if kind == FREE or kind == DISTANCE:
        v = wp.vec3(qd[t, w, i], qd[t, w, i + 1], qd[t, w, i + 2])
        omega = wp.vec3(qd[t, w, i + 3], qd[t, w, i + 4], qd[t, w, i + 5])
    elif kind == BALL:
        omega = wp.vec3(qd[t, w, i], qd[t, w, i + 1], qd[t, w, i + 2])
    else:
        linear = table.linear_axes[j]
        first = table.q_start[j] + linear
        for k in range(linear):
            v += table.axis[i + k] * qd[t, w, i + k]
        rotation = wp.quat_identity()
        for k in range(table.angular_axes[j]):
            axis = table.axis[i + linear + k]
            omega += wp.quat_rotate(rotation, axis) * qd[t, w, i + linear + k]
            rotation = rotation * wp.quat_from_axis_angle(axis, q[t, w, first + k])
    return wp.spatial_vector(v, omega)


@wp.func
def forward_kinematics(
    table: JointTable,
    t: int,
    w: int,
    q: wp.array3d[float],
    qd: wp.array3d[float],
    body_q: wp.array3d[wp.transform],
    body_qd: wp.array3d[wp.spatial_vector],
):
    """Body poses and centre-of-mass twists of world w at step t, written to body_q[t, w] and body_qd[t, w]."""
    for j in range(table.type.shape[0]):
        parent = table.parent[j]
        child = table.child[j]
        kind = table.type[j]

        anchor = table.pose_parent[j]
        v_anchor = wp.vec3(0.0)
        w_parent = wp.vec3(0.0)
        if parent >= 0:
            anchor = body_q[t, w, parent] * anchor
        if table.mocap[j] >= 0:
            anchor = table.mocap_pose[w, table.mocap[j]]
        # most joints only slide, turn about one axis, or nothing: leave out what multiplies by one and adds zero
        slides = kind != FREE and kind != DISTANCE and kind != BALL and table.angular_axes[j] == 0
        turn = wp.transform_get_rotation(anchor)
        moved = anchor
        v_joint = wp.vec3(0.0)
        w_joint = wp.vec3(0.0)
        if not slides:
            moved = anchor * joint_transform(table, j, q, t, w)
            local = joint_twist(table, j, q, qd, t, w)
            v_joint = wp.quat_rotate(turn, wp.spatial_top(local))
            w_joint = wp.quat_rotate(turn, wp.spatial_bottom(local))
        elif table.linear_axes[j] > 0:
            way = wp.vec3(0.0)
            speed = wp.vec3(0.0)
            for k in range(table.linear_axes[j]):
                axis = table.axis[table.qd_start[j] + k]
                way += axis * q[t, w, table.q_start[j] + k]
                speed += axis * qd[t, w, table.qd_start[j] + k]
            moved = wp.transform(wp.transform_get_translation(anchor) + wp.quat_rotate(turn, way), turn)
            v_joint = wp.quat_rotate(turn, speed)
        pose = moved
        if table.centred[j] == 0:
            pose = moved * wp.transform_inverse(table.pose_child[j])
        origin = wp.transform_get_translation(pose)
        com = wp.transform_point(pose, table.body_com[child])
        if parent >= 0:
            twist = body_qd[t, w, parent]
            w_parent = wp.spatial_bottom(twist)
            parent_com = wp.transform_point(body_q[t, w, parent], table.body_com[parent])
            v_anchor = wp.spatial_top(twist) + wp.cross(w_parent, origin - parent_com)

        if kind == FREE or kind == DISTANCE:
            v_joint -= wp.cross(w_joint, com - origin)
        elif table.centred[j] == 0:
            v_joint += wp.cross(w_joint, origin - wp.transform_get_translation(moved))

        omega = w_parent + w_joint
        body_q[t, w, child] = pose
        body_qd[t, w, child] = wp.spatial_vector(v_anchor + v_joint + wp.cross(omega, com - origin), omega)


@wp.kernel
def forward_kinematics_kernel(
    # inputs
    table: JointTable,
    joint_q: wp.array3d[float],  # [T, W, nq]
    joint_qd: wp.array3d[float],  # [T, W, nv]
    # outputs
    body_q: wp.array3d[wp.transform],  # [T, W, nb]
    body_qd: wp.array3d[wp.spatial_vector],  # [T, W, nb] twist of the centre of mass, world frame
):
    """One thread: the body poses and twists of one world at one step."""
    t, w = wp.tid()
    forward_kinematics(table, t, w, joint_q, joint_qd, body_q, body_qd)
