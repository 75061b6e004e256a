# SPDX-License-Identifier: Apache-2.0
"""Points of bodies whose positions and velocities residuals sum, and wanted numbers that are scalars of the task.

Signed distances from primitive shapes.
"""

import warp as wp

from .view import TASK_BODY, StepView, task_scalar

wp.set_module_options({"enable_backward": False})


@wp.struct
class Wanted:
    """Wanted values of a residual: fixed numbers, or scalars of the task."""

    value: wp.array[float]  # [n]
    scalar: wp.array[int]  # [n] -1 for those that are fixed


@wp.func
def wanted(s: StepView, p: Wanted, i: int) -> float:
    """Wanted value of number i."""
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


wp.set_module_options({"enable_backward": False})

SPHERE = wp.constant(0)
BOX = wp.constant(1)
CYLINDER = wp.constant(2)
CAPSULE = wp.constant(3)
PLANE = wp.constant(4)
MESH = wp.constant(5)
"""Kind of a shape whose distance a volume tells."""


@wp.func
def shape_distance(kind: int, size: wp.vec3, p: wp.vec3) -> float:
    """Signed distance from a point in a shape's frame to its surface [m]; sizes are half extents or radius, half."""
    if kind == SPHERE:
        return wp.length(p) - size[0]
    if kind == CAPSULE:
        return wp.length(p - wp.vec3(0.0, 0.0, wp.clamp(p[2], -size[1], size[1]))) - size[0]
    if kind == PLANE:
        return p[2]
    q = wp.vec3(wp.abs(p[0]) - size[0], wp.abs(p[1]) - size[1], wp.abs(p[2]) - size[2])
    if kind == CYLINDER:
        q = wp.vec3(wp.length(wp.vec2(p[0], p[1])) - size[0], wp.abs(p[2]) - size[1], -wp.inf)
    outside = wp.length(wp.vec3(wp.max(q[0], 0.0), wp.max(q[1], 0.0), wp.max(q[2], 0.0)))
    return outside + wp.min(wp.max(q[0], wp.max(q[1], q[2])), 0.0)
