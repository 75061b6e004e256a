# SPDX-License-Identifier: Apache-2.0
"""Postures that bring a frame to a pose, searched for from plan to plan, and straight ways of the joints to them.

A few candidates per environment take some steps of damped least squares in every plan, so that they follow a pose that
moves. The one whose rows cost most in the last plan gives way to a new one: what the rollouts know of obstacles, limits
and preferences chooses among the postures, and the search goes on. Their rows are ancillary proposals (Trevisan and
Alonso-Mora 2024).
"""

import warp as wp

from ..geometry.jacobian import Chain, jacobian_column, solve_damped
from ..geometry.kinematics import JointTable, joint_transform

wp.set_module_options({"enable_backward": False})

_STREAM = wp.constant(0xB0D7)
"""Keeps these random numbers apart from those of the samples."""


@wp.struct
class Reach:
    """Frames, their targets and the joints that bring them there."""

    table: JointTable
    chain: Chain  # its columns are the driven joints
    joint: wp.array[int]  # [n] joints from the root to the frame's body
    tip: int  # the frame's body
    frame: wp.transform  # the frame in its body
    pose: int  # pose of the task that it is brought to
    target: wp.transform  # in the frame of that pose
    lower: wp.array[float]  # [columns]
    upper: wp.array[float]  # [columns]
    control: wp.array[int]  # [columns] control that drives the joint
    order: wp.array[int]  # [columns] what the control is: 0 position, 1 velocity, 2 acceleration
    dof: wp.array[int]  # [columns] joint velocity


@wp.func
def chain_kinematics(r: Reach, q: wp.array3d[float], w: int, body_q: wp.array3d[wp.transform]) -> wp.transform:
    """Poses of the bodies along the chain, written to body_q[0, w]; returns the frame's."""
    for i in range(r.joint.shape[0]):
        j = r.joint[i]
        anchor = r.table.pose_parent[j]
        if r.table.parent[j] >= 0:
            anchor = body_q[0, w, r.table.parent[j]] * anchor
        if r.table.mocap[j] >= 0:
            anchor = r.table.mocap_pose[w, r.table.mocap[j]]
        pose = anchor * joint_transform(r.table, j, q, 0, w)
        if r.table.centred[j] == 0:
            pose = pose * wp.transform_inverse(r.table.pose_child[j])
        body_q[0, w, r.table.child[j]] = pose
    return body_q[0, w, r.tip] * r.frame


@wp.func
def coordinate(r: Reach, column: int) -> int:
    """Joint coordinate of a column."""
    return r.chain.coord[r.chain.column[column]]


@wp.kernel
def replace_posture_kernel(
    # inputs
    observed: wp.array[int],  # [E] whether there is an observation to plan from
    cost: wp.array2d[float],  # [E, S] of the last plan
    first: int,  # sample that the first row is
    rows: int,  # rows of one posture
    min_age: int,  # plans for which a posture stays at least
    near: float,  # [m and rad] a posture whose pose is farther off than this has not found it
    miss: wp.array2d[float],  # [E, M] how far off poses are [m and rad]
    # outputs
    age: wp.array2d[int],  # [E, M] plans since a posture was begun; 0 begins it
):
    """One thread: let the posture of one environment whose best row cost most give way, among those of that age.

    Those that have not found the pose by then go first; of the others the best stays.
    """
    e = wp.tid()
    if observed[e] == 0:
        return
    worst = int(-1)
    most = float(-wp.inf)
    old_enough = int(0)
    for m in range(age.shape[1]):
        if age[e, m] >= min_age:
            old_enough += 1
            least = float(wp.inf)
            for k in range(rows):
                least = wp.min(least, cost[e, first + m * rows + k])
            if miss[e, m] > near:
                least = wp.inf
            if worst < 0 or least > most:
                most = least
                worst = m
    for m in range(age.shape[1]):
        goes = m == worst and (old_enough > 1 or most == wp.inf)
        age[e, m] = wp.where(goes, 0, age[e, m] + 1)


@wp.kernel
def search_posture_kernel(
    # inputs
    observed: wp.array[int],  # [E] whether there is an observation to plan from
    joint_q: wp.array2d[float],  # [E, nq]
    pose: wp.array2d[wp.transform],  # [E, poses] of the task
    r: Reach,
    age: wp.array2d[int],  # [E, M]
    counter: wp.array[int],  # [E] plans made so far
    seed: int,
    steps: int,
    damping: float,
    stride: float,  # [m or rad] greatest change of a joint in a step
    # outputs
    q: wp.array3d[float],  # [1, E·M, nq] the postures
    miss: wp.array2d[float],  # [E, M] how far off the pose was before the last step [m and rad]
    body_q: wp.array3d[wp.transform],  # [1, E·M, nb] of the bodies along the chain
    jacobian: wp.array2d[wp.spatial_vector],  # [E·M, columns]
):
    """One thread: some steps of damped least squares of one posture, begun anew at age 0.

    What the chain's columns do not move is where it is observed. The first posture of all begins there, too, the others
    anywhere within the limits.
    """
    w = wp.tid()
    count = age.shape[1]
    e = w // count
    m = w % count
    if observed[e] == 0:
        return
    columns = r.control.shape[0]
    for i in range(joint_q.shape[1]):
        driven = int(0)
        for c in range(columns):
            if coordinate(r, c) == i:
                driven = 1
        if driven == 0:
            q[0, w, i] = joint_q[e, i]
    if age[e, m] == 0:
        state = wp.rand_init(seed ^ _STREAM, counter[e] * q.shape[1] + w)
        for c in range(columns):
            i = coordinate(r, c)
            q[0, w, i] = joint_q[e, i]
            if counter[e] > 1 or m > 0:
                q[0, w, i] = wp.lerp(r.lower[c], r.upper[c], wp.randf(state))

    goal = pose[e, r.pose] * r.target
    for _ in range(steps):
        at = chain_kinematics(r, q, w, body_q)
        about = wp.transform_get_translation(at)
        turn = wp.transform_get_rotation(goal) * wp.quat_inverse(wp.transform_get_rotation(at))
        turn = wp.where(turn[3] < 0.0, -turn, turn)
        axis = wp.vec3(turn[0], turn[1], turn[2])
        sine = wp.length(axis)
        angle = 2.0 * wp.atan2(sine, turn[3])
        rotation = axis * wp.where(sine > 1.0e-9, angle / wp.max(sine, 1.0e-9), 2.0)
        way = wp.spatial_vector(wp.transform_get_translation(goal) - about, rotation)
        miss[e, m] = wp.length(way)
        gram = wp.spatial_matrix(0.0)
        for c in range(columns):
            column = jacobian_column(r.chain, c, about, q, body_q, 0, w)
            jacobian[w, c] = column
            gram += wp.outer(column, column)
        x = solve_damped(gram, damping, way)
        largest = float(1.0e-9)
        for c in range(columns):
            largest = wp.max(largest, wp.abs(wp.dot(jacobian[w, c], x)))
        share = wp.min(1.0, stride / largest)
        for c in range(columns):
            i = coordinate(r, c)
            q[0, w, i] = wp.clamp(q[0, w, i] + share * wp.dot(jacobian[w, c], x), r.lower[c], r.upper[c])


@wp.kernel
def posture_rows_kernel(
    # inputs
    joint_q: wp.array2d[float],  # [E, nq]
    joint_qd: wp.array2d[float],  # [E, nv]
    null: wp.array2d[float],  # [E, nu] control that asks for nothing
    r: Reach,
    q: wp.array3d[float],  # [1, E·M, nq] the postures
    near: float,  # [m and rad] a posture whose pose is farther off than this has not found it
    miss: wp.array2d[float],  # [E, M] how far off poses are [m and rad]
    duration: wp.array[float],  # [K] [s]
    time: wp.array[float],  # [P] of the knots [s]
    # outputs
    rows: wp.array4d[float],  # [M·K, E, P, nu]
):
    """One thread: the knots of one row, on the cubic from the observed joints and velocities to rest in a posture.

    The row of a posture that has not found the pose asks for nothing: half-way there it may lead where no way goes on.
    """
    row, e = wp.tid()
    count = rows.shape[0] // duration.shape[0]
    m = row // duration.shape[0]
    w = e * count + m
    d = duration[row % duration.shape[0]]

    for p in range(rows.shape[2]):
        for u in range(rows.shape[3]):
            rows[row, e, p, u] = null[e, u]
        t = wp.min(time[p], d)
        moving = wp.where(miss[e, m] > near, 0, r.control.shape[0])
        for c in range(moving):
            i = coordinate(r, c)
            v = joint_qd[e, r.dof[c]]
            way = q[0, w, i] - joint_q[e, i]
            first = 6.0 * way / (d * d) - 4.0 * v / d  # acceleration at the start, and its change
            change = (6.0 * v / d - 12.0 * way / (d * d)) / d
            value = first + change * t
            if time[p] > d:
                value = 0.0
            if r.order[c] == 1:
                value = v + t * (first + 0.5 * change * t)
            elif r.order[c] == 0:
                value = joint_q[e, i] + t * (v + t * (0.5 * first + change * t / 6.0))
            rows[row, e, p, r.control[c]] = value
