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
def among_axes(
    chain: Chain, near: wp.vec3, joint_q: wp.array3d[float], body_q: wp.array3d[wp.transform], t: int, w: int
) -> wp.vec3:
    """The point with the least squared distance from all axes that turn, ``near`` if there is none [m].

    About it Σ ‖a × (c - p)‖² is least. Where the axes leave it free, as parallel ones do, it stays near ``near``.
    """
    h = wp.spatial_matrix(0.0)
    g = wp.spatial_vector()
    for c in range(chain.column.shape[0]):
        i = chain.column[c]
        if chain.turns[i] != 0:
            a = joint_axis(chain, i, joint_q, body_q, t, w)
            across = wp.identity(n=3, dtype=float) - wp.outer(a.direction, a.direction)
            miss = across * (a.point - near)
            for r in range(3):
                g[r] += miss[r]
                for k in range(3):
                    h[r, k] += across[r, k]
    x = ldlt_solve(h, 3, 1.0e-3, g)
    return near + wp.vec3(x[0], x[1], x[2])


@wp.func
def ldlt(m: wp.spatial_matrix, n: int) -> wp.spatial_matrix:
    """Factor the leading n × n block of a symmetric positive semidefinite matrix: D on the diagonal, L below it.

    Pivots that rounding makes negative are zero, and so is what stands below a pivot of zero.
    """
    f = m
    for k in range(n):
        d = wp.max(f[k, k], 0.0)
        f[k, k] = d
        for i in range(k + 1, n):
            below = f[i, k]
            if d > 0.0:
                for j in range(k + 1, i):
                    f[i, j] -= below * f[j, k]
                f[i, i] -= below * below / d
                f[i, k] = below / d
            else:
                f[i, k] = 0.0
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
def ldlt_solve(m: wp.spatial_matrix, n: int, damping: float, b: wp.spatial_vector) -> wp.spatial_vector:
    """Solve (M + damping · I) x = b, for the leading n × n block of a symmetric positive semidefinite matrix."""
    damped = m
    for k in range(n):
        damped[k, k] = m[k, k] + damping
    f = ldlt(damped, n)
    x = b
    for i in range(n):
        for j in range(i):
            x[i] -= f[i, j] * x[j]
    for i in range(n):
        x[i] = wp.where(f[i, i] > 0.0, x[i] / f[i, i], 0.0)
    for r in range(n):
        i = n - 1 - r
        for j in range(i + 1, n):
            x[i] -= f[j, i] * x[j]
    return x


@wp.func
def manipulability_of(
    chain: Chain, at: wp.vec3, joint_q: wp.array3d[float], body_q: wp.array3d[wp.transform], t: int, w: int
) -> float:
    """√det(J Jᵀ) of a chain's Jacobian about a point (Yoshikawa 1985), √det(Jᵀ J) for fewer than six axes.

    det(J Jᵀ) is the same about every point, so it is taken about the one that lies best among the axes: about a
    distant one angular and linear rows are nearly dependent, which float32 cannot tell from a singular posture.
    """
    n = chain.column.shape[0]
    gram = wp.spatial_matrix(0.0)
    if n >= 6:
        c = among_axes(chain, at, joint_q, body_q, t, w)
        for i in range(n):
            column = angular_first(jacobian_column(chain, i, c, joint_q, body_q, t, w))
            gram += wp.outer(column, column)
        return root_determinant(gram, 6)
    for i in range(n):
        first = jacobian_column(chain, i, at, joint_q, body_q, t, w)
        for k in range(i + 1):
            gram[i, k] = wp.dot(first, jacobian_column(chain, k, at, joint_q, body_q, t, w))
    return root_determinant(gram, n)
