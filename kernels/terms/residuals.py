# SPDX-License-Identifier: Apache-2.0
"""Residuals in space and what their norms cost: places, velocities and momenta of frames and centres of mass.

A residual is a few numbers that shall be zero. Its function returns them in the world's frame, its cost is a norm
(``norms``) of those that count, less what is wanted.
"""

import warp as wp

from .norms import Norm, norm_part, norm_total
from .view import TASK_BODY, StepView, task_scalar

wp.set_module_options({"enable_backward": False})


@wp.struct
class Wanted:
    """What numbers of a residual shall be: fixed numbers, or scalars of the task."""

    value: wp.array[float]  # [n]
    scalar: wp.array[int]  # [n] -1 for those that are fixed


@wp.func
def wanted(s: StepView, p: Wanted, i: int) -> float:
    """What number i shall be."""
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
    """Where a point of a body is [m]."""
    if body <= TASK_BODY:
        return wp.transform_point(s.pose[s.e, TASK_BODY - body], at)
    if body < 0:
        return at
    return wp.transform_point(s.body_q[s.t, s.w, body], at)


@wp.func
def point_velocity(s: StepView, body: int, at: wp.vec3) -> wp.vec3:
    """How fast a point of a body moves [m/s]."""
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


@wp.struct
class SpatialParams:
    """Parameters of residuals in space."""

    points: Points
    axis: wp.array[int]  # [n] axes of the world that count, in their order
    wanted: Wanted
    norm: Norm


@wp.func
def spatial_cost(s: StepView, r: wp.vec3, p: SpatialParams) -> float:
    """Norm of the components that count, less what is wanted."""
    total = float(0.0)
    for i in range(p.axis.shape[0]):
        total += norm_part(r[p.axis[i]] - wanted(s, p.wanted, i), p.norm)
    return norm_total(total, p.norm)


@wp.func
def position_component(s: StepView, p: SpatialParams, i: int) -> float:
    """Number i of ``position_residual``."""
    return points_position(s, p.points)[p.axis[i]] - wanted(s, p.wanted, i)


@wp.func
def position_residual(s: StepView, p: SpatialParams) -> float:
    """Norm of a place's position from another one's, less the wanted one [m]."""
    return spatial_cost(s, points_position(s, p.points), p)


@wp.func
def velocity_component(s: StepView, p: SpatialParams, i: int) -> float:
    """Number i of ``velocity_residual``."""
    return points_velocity(s, p.points)[p.axis[i]] - wanted(s, p.wanted, i)


@wp.func
def velocity_residual(s: StepView, p: SpatialParams) -> float:
    """Norm of a place's velocity from another one's, less the wanted one [m/s]."""
    return spatial_cost(s, points_velocity(s, p.points), p)
