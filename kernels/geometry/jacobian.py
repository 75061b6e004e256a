# SPDX-License-Identifier: Apache-2.0
"""Geometric Jacobians of frames along a chain of joints, and what is read off them: manipulability, null spaces.

A column of the Jacobian is the twist that one joint velocity of 1 gives, linear before angular as in Newton:
(a × (c - p), a) for an axis a through p that turns, (a, 0) for one that slides, c the point that is looked at. The
axes are read off the recorded body poses, so that nothing is stored and every engine's rollouts will do.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Chain:
    """The joint axes between a frame and the root of its robot, tip first."""

    column: wp.array[int]  # [n] which axes are columns of the Jacobian
    coord: wp.array[int]  # [na] joint coordinate
    turns: wp.array[int]  # [na] 1 if it turns, 0 if it slides
    after: wp.array[int]  # [na] how many axes of the same joint come after it, nearer to the tip
    axis: wp.array[wp.vec3]  # [na] in the joint's frame
    body: wp.array[int]  # [na] child of its joint
    anchor: wp.array[wp.transform]  # [na] the joint's frame in the child's


@wp.struct
class JointAxis:
    """A joint axis in the world's frame."""

    direction: wp.vec3  # unit length
    point: wp.vec3  # on the axis of a joint that turns [m]


@wp.func
def joint_axis(
    chain: Chain, i: int, joint_q: wp.array3d[float], body_q: wp.array3d[wp.transform], t: int, w: int
) -> JointAxis:
    """Axis i of a chain in world w at step t, from the pose of the body that it moves."""
    frame = body_q[t, w, chain.body[i]] * chain.anchor[i]
    turn = wp.transform_get_rotation(frame)
    # back over the turns of the same joint that follow: intrinsic order, as in forward kinematics
    for k in range(i - chain.after[i], i):
        if chain.turns[k] != 0:
            turn = turn * wp.quat_from_axis_angle(chain.axis[k], -joint_q[t, w, chain.coord[k]])
    out = JointAxis()
    out.direction = wp.quat_rotate(turn, chain.axis[i])
    out.point = wp.transform_get_translation(frame)
    return out


@wp.func
def jacobian_column(
    chain: Chain,
    column: int,
    about: wp.vec3,
    joint_q: wp.array3d[float],
    body_q: wp.array3d[wp.transform],
    t: int,
    w: int,
) -> wp.spatial_vector:
    """A column of the Jacobian of the point ``about`` of the chain's tip: linear [m/rad or 1], angular [1 or 1/m]."""
    i = chain.column[column]
    a = joint_axis(chain, i, joint_q, body_q, t, w)
    if chain.turns[i] == 0:
        return wp.spatial_vector(a.direction, wp.vec3(0.0))
    return wp.spatial_vector(wp.cross(a.direction, about - a.point), a.direction)


@wp.func
def angular_first(twist: wp.spatial_vector) -> wp.spatial_vector:
    """A twist with its angular part before the linear one."""
    return wp.spatial_vector(wp.spatial_bottom(twist), wp.spatial_top(twist))


@wp.func
def ldlt(m: wp.spatial_matrix, n: int) -> wp.spatial_matrix:
    """Factor the leading n × n block of a symmetric positive semidefinite matrix: D on the diagonal, L below it.

    Pivots that rounding makes negative are zero, and so is what stands below a pivot of zero.
    """
    f = m
    for k in range(n):
        d = wp.max(f[k, k], 0.0)
        f[k, k] = d
        inverse = wp.where(d > 0.0, 1.0 / d, 0.0)
        for i in range(k + 1, n):
            below = f[i, k]
            share = below * inverse
            for j in range(k + 1, i):
                f[i, j] -= below * f[j, k]
            f[i, i] -= below * share
            f[i, k] = share
    return f


@wp.func
def root_determinant(m: wp.spatial_matrix, n: int) -> float:
    """√det of the leading n × n block of a symmetric positive semidefinite matrix."""
    f = ldlt(m, n)
    product = float(1.0)
    for k in range(n):
        product *= wp.sqrt(f[k, k])
    return product


@wp.func
def solve_damped(m: wp.spatial_matrix, damping: float, b: wp.spatial_vector) -> wp.spatial_vector:
    """Solve (M + damping · I) x = b for a symmetric positive semidefinite matrix."""
    f = ldlt(m + damping * wp.identity(n=6, dtype=float), 6)
    x = b
    for i in range(6):
        for j in range(i):
            x[i] -= f[i, j] * x[j]
    for i in range(6):
        x[i] = wp.where(f[i, i] > 0.0, x[i] / f[i, i], 0.0)
    for r in range(6):
        for j in range(6 - r, 6):
            x[5 - r] -= f[j, 5 - r] * x[j]
    return x


@wp.func
def manipulability_of(
    chain: Chain, at: wp.vec3, joint_q: wp.array3d[float], body_q: wp.array3d[wp.transform], t: int, w: int
) -> float:
    """√det(J Jᵀ) of a chain's Jacobian about a point (Yoshikawa 1985), √det(Jᵀ J) for fewer than six axes.

    det(J Jᵀ) is the same about every point, so it is taken about the joint half-way along the chain: about a distant
    point angular and linear rows are nearly dependent, which float32 cannot tell from a singular posture.
    """
    n = chain.column.shape[0]
    gram = wp.spatial_matrix(0.0)
    if n >= 6:
        c = joint_axis(chain, chain.column[n // 2], joint_q, body_q, t, w).point
        for i in range(n):
            column = angular_first(jacobian_column(chain, i, c, joint_q, body_q, t, w))
            gram += wp.outer(column, column)
        return root_determinant(gram, 6)
    for i in range(n):
        first = jacobian_column(chain, i, at, joint_q, body_q, t, w)
        for k in range(i + 1):
            gram[i, k] = wp.dot(first, jacobian_column(chain, k, at, joint_q, body_q, t, w))
    return root_determinant(gram, n)
