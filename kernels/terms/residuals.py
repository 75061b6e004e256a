# SPDX-License-Identifier: Apache-2.0
"""Residuals in space and what their norms cost: frames, centres of mass, momenta.

A residual is a few numbers that shall be zero. Its function returns them in the world's frame, its cost is a norm
(``norms``) of those that count, less what is wanted.
"""

import warp as wp

from .norms import Norm, norm_part, norm_total
from .view import TASK_BODY, StepView, frame_rotation, task_scalar

wp.set_module_options({"enable_backward": False})


@wp.struct
class Wanted:
    """Targets of a residual's numbers: fixed numbers, or scalars of the task."""

    value: wp.array[float]  # [n]
    scalar: wp.array[int]  # [n] -1 for those that are fixed


@wp.func
def wanted(s: StepView, p: Wanted, i: int) -> float:
    """Target of number i."""
    scalar = p.scalar[i]
    if scalar >= 0:
        return task_scalar(s, scalar)
    return p.value[i]


@wp.struct
class Points:
    """Points of bodies, and how much each counts in their sum: a mean, a centre of mass, a difference of two such."""

    body: wp.array[int]  # [n] body, -1 world, -2 and below poses of the task
    at: wp.array[wp.vec3]  # [n] in the body's frame [m]
    share: wp.array[float]  # [n]
    lead: wp.array[float]  # [n] moved on by its velocity for this time [s]


@wp.func
def point_position(s: StepView, body: int, at: wp.vec3) -> wp.vec3:
    """Position of a point of a body [m]."""
    if body <= TASK_BODY:
        return wp.transform_point(s.pose[s.e, TASK_BODY - body], at)
    if body < 0:
        return at
    return wp.transform_point(s.body_q[s.t, s.w, body], at)


@wp.func
def point_velocity(s: StepView, body: int, at: wp.vec3) -> wp.vec3:
    """Velocity of a point of a body [m/s]."""
    if body < 0:
        return wp.vec3(0.0)
    twist = s.body_qd[s.t, s.w, body]
    arm = wp.quat_rotate(wp.transform_get_rotation(s.body_q[s.t, s.w, body]), at - s.body_com[body])
    return wp.spatial_top(twist) + wp.cross(wp.spatial_bottom(twist), arm)


@wp.func
def points_position(s: StepView, p: Points) -> wp.vec3:
    """Σ share · position, with what each moves on by."""
    total = wp.vec3(0.0)
    for i in range(p.body.shape[0]):
        x = point_position(s, p.body[i], p.at[i])
        if p.lead[i] != 0.0:
            x += p.lead[i] * point_velocity(s, p.body[i], p.at[i])
        total += p.share[i] * x
    return total


@wp.func
def points_velocity(s: StepView, p: Points) -> wp.vec3:
    """Σ share · velocity."""
    total = wp.vec3(0.0)
    for i in range(p.body.shape[0]):
        total += p.share[i] * point_velocity(s, p.body[i], p.at[i])
    return total


@wp.func
def points_angular_velocity(s: StepView, p: Points) -> wp.vec3:
    """Σ share · angular velocity of the points' bodies."""
    total = wp.vec3(0.0)
    for i in range(p.body.shape[0]):
        body = p.body[i]
        if body >= 0:
            total += p.share[i] * wp.spatial_bottom(s.body_qd[s.t, s.w, body])
    return total


@wp.struct
class SpatialParams:
    """Parameters of residuals in space."""

    points: Points
    axis: wp.array[int]  # [n] axes that count, in their order
    heading: int  # frame with whose heading the axes turn, -1 for the world's
    wanted: Wanted
    norm: Norm


@wp.func
def along(s: StepView, r: wp.vec3, p: SpatialParams) -> wp.vec3:
    """A vector along the axes: ahead, to the left and up where they turn with a heading, the x axis seen from above."""
    if p.heading < 0:
        return r
    ahead = wp.quat_rotate(frame_rotation(s, p.heading), wp.vec3(1.0, 0.0, 0.0))
    # a frame that looks straight up has no heading
    scale = 1.0 / wp.max(wp.sqrt(ahead[0] * ahead[0] + ahead[1] * ahead[1]), 1.0e-6)
    cosine = scale * ahead[0]
    sine = scale * ahead[1]
    return wp.vec3(cosine * r[0] + sine * r[1], cosine * r[1] - sine * r[0], r[2])


@wp.func
def spatial_cost(s: StepView, r: wp.vec3, p: SpatialParams) -> float:
    """Norm of the components that count, less what is wanted."""
    total = float(0.0)
    v = along(s, r, p)
    for i in range(p.axis.shape[0]):
        total += norm_part(v[p.axis[i]] - wanted(s, p.wanted, i), p.norm)
    return norm_total(total, p.norm)


@wp.func
def position_component(s: StepView, p: SpatialParams, i: int) -> float:
    """Number i of ``position_residual``."""
    return along(s, points_position(s, p.points), p)[p.axis[i]] - wanted(s, p.wanted, i)


@wp.func
def position_residual(s: StepView, p: SpatialParams) -> float:
    """Norm of a place's position from another one's, less the wanted one [m]."""
    return spatial_cost(s, points_position(s, p.points), p)


@wp.func
def velocity_component(s: StepView, p: SpatialParams, i: int) -> float:
    """Number i of ``velocity_residual``."""
    return along(s, points_velocity(s, p.points), p)[p.axis[i]] - wanted(s, p.wanted, i)


@wp.func
def velocity_residual(s: StepView, p: SpatialParams) -> float:
    """Norm of a place's velocity from another one's, less the wanted one [m/s]."""
    return spatial_cost(s, points_velocity(s, p.points), p)


@wp.func
def momentum_residual(s: StepView, p: SpatialParams) -> float:
    """Norm of the linear momentum, less the wanted one [kg m/s]."""
    return velocity_residual(s, p)  # shares are masses


@wp.func
def angular_velocity_component(s: StepView, p: SpatialParams, i: int) -> float:
    """Number i of ``angular_velocity_residual``."""
    return along(s, points_angular_velocity(s, p.points), p)[p.axis[i]] - wanted(s, p.wanted, i)


@wp.func
def angular_velocity_residual(s: StepView, p: SpatialParams) -> float:
    """Norm of a frame's angular velocity from another one's, less the wanted one [rad/s]."""
    return spatial_cost(s, points_angular_velocity(s, p.points), p)


@wp.struct
class AngularMomentumParams:
    """Parameters of ``angular_momentum_residual``."""

    own: SpatialParams  # centre of mass of what turns
    mass: wp.array[float]  # [n] of each of its bodies [kg]
    inertia: wp.array[wp.mat33]  # [n] about its centre of mass, along the body's axes [kg m²]


@wp.func
def angular_momentum(s: StepView, p: AngularMomentumParams) -> wp.vec3:
    """Angular momentum about the centre of mass, Σ I ω + m (x - c) × (v - ċ) [kg m²/s]."""
    centre = points_position(s, p.own.points)
    moving = points_velocity(s, p.own.points)
    total = wp.vec3(0.0)
    for i in range(p.mass.shape[0]):
        body = p.own.points.body[i]
        pose = s.body_q[s.t, s.w, body]
        twist = s.body_qd[s.t, s.w, body]
        turn = wp.transform_get_rotation(pose)
        x = wp.transform_point(pose, p.own.points.at[i])
        spin = wp.quat_rotate_inv(turn, wp.spatial_bottom(twist))
        total += wp.quat_rotate(turn, p.inertia[i] * spin)
        total += p.mass[i] * wp.cross(x - centre, wp.spatial_top(twist) - moving)
    return total


@wp.func
def angular_momentum_component(s: StepView, p: AngularMomentumParams, i: int) -> float:
    """Number i of ``angular_momentum_residual``."""
    return along(s, angular_momentum(s, p), p.own)[p.own.axis[i]] - wanted(s, p.own.wanted, i)


@wp.func
def angular_momentum_residual(s: StepView, p: AngularMomentumParams) -> float:
    """Norm of the angular momentum about the centre of mass, less the wanted one [kg m²/s]."""
    return spatial_cost(s, angular_momentum(s, p), p.own)


@wp.struct
class RotationParams:
    """Parameters of ``rotation_residual``."""

    of: int
    to: int
    axis: wp.array[int]  # [n] axes of the frames that are compared
    norm: Norm


@wp.func
def axis_difference(s: StepView, p: RotationParams, i: int) -> wp.vec3:
    """(R_a e - R_b e)/√2 of the axis e that is compared as number i."""
    e = wp.vec3(0.0)
    e[p.axis[i]] = 0.7071067811865476
    return wp.quat_rotate(frame_rotation(s, p.of), e) - wp.quat_rotate(frame_rotation(s, p.to), e)


@wp.func
def rotation_component(s: StepView, p: RotationParams, i: int) -> float:
    """Number i of ``rotation_residual``."""
    return axis_difference(s, p, i // 3)[i % 3]


@wp.func
def rotation_residual(s: StepView, p: RotationParams) -> float:
    """Norm of (R_a - R_b)/√2, whose length is 2 sin(θ/2) of the angle θ between two frames."""
    total = float(0.0)
    for i in range(p.axis.shape[0]):
        d = axis_difference(s, p, i)
        for k in range(3):
            total += norm_part(d[k], p.norm)
    return norm_total(total, p.norm)
