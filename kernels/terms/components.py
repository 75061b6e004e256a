# SPDX-License-Identifier: Apache-2.0
"""The numbers behind the terms of ``general``, for planners that take their derivatives: what each is a norm of.

Squares are halves of squares of √2 times the number; lengths and angles are lengths of vectors.
"""

import warp as wp

from .general import (
    ControlParams,
    DistanceParams,
    HeightParams,
    JointLimitParams,
    JointVelocityParams,
    OrientationParams,
    PostureParams,
    YawParams,
)
from .view import (
    StepView,
    control,
    frame_position,
    frame_rotation,
    frame_velocity,
    joint_position,
    joint_velocity,
    wrap_angle,
    yaw,
)

wp.set_module_options({"enable_backward": False})

ROOT_TWO = wp.constant(1.4142135623730951)


@wp.func
def distance_component(s: StepView, p: DistanceParams, i: int) -> float:
    """Axis i of the way between two frames [m]."""
    a = frame_position(s, p.first) + p.lead * frame_velocity(s, p.first)
    return (a - frame_position(s, p.second))[i]


@wp.func
def yaw_component(s: StepView, p: YawParams, i: int) -> float:
    """Heading error, with its sign [rad]."""
    return wrap_angle(yaw(frame_rotation(s, p.of)) - yaw(frame_rotation(s, p.to)))


@wp.func
def control_component(s: StepView, p: ControlParams, i: int) -> float:
    """Control i of the range by its half range."""
    u = p.first + i
    return ROOT_TWO * control(s, u) / s.control_scale[u]


@wp.func
def control_rate_component(s: StepView, p: ControlParams, i: int) -> float:
    """Change of control i of the range by its half range."""
    u = p.first + i
    before = s.last_control[s.e, u]
    if s.t > 1:
        before = s.controls[s.t - 2, s.w, u]
    return ROOT_TWO * (control(s, u) - before) / s.control_scale[u]


@wp.func
def joint_limit_component(s: StepView, p: JointLimitParams, i: int) -> float:
    """Distance of joint i outside its limits [m or rad]."""
    q = joint_position(s, p.coord[i])
    return ROOT_TWO * wp.max(wp.max(p.lower[i] - q, q - p.upper[i]), 0.0)


@wp.func
def joint_velocity_component(s: StepView, p: JointVelocityParams, i: int) -> float:
    """Velocity of joint i [m/s or rad/s]."""
    return ROOT_TWO * joint_velocity(s, p.joint[i])


@wp.func
def posture_component(s: StepView, p: PostureParams, i: int) -> float:
    """Distance of joint i from its place [m or rad]."""
    return ROOT_TWO * (joint_position(s, p.coord[i]) - p.target[i])


@wp.func
def height_component(s: StepView, p: HeightParams, i: int) -> float:
    """Height of a frame above or below the one that it shall have, less the slack [m]."""
    error = frame_position(s, p.of)[2] - p.target
    return wp.sign(error) * wp.max(wp.abs(error) - p.slack, 0.0)


@wp.func
def orientation_component(s: StepView, p: OrientationParams, i: int) -> float:
    """Axis i of the rotation vector between two frames, or between their z axes [rad]."""
    a = frame_rotation(s, p.of)
    b = frame_rotation(s, p.to)
    if p.tilt != 0:
        za = wp.quat_rotate(a, wp.vec3(0.0, 0.0, 1.0))
        zb = wp.quat_rotate(b, wp.vec3(0.0, 0.0, 1.0))
        axis = wp.cross(za, zb)
        size = wp.length(axis)
        return axis[i] * wp.where(size > 1.0e-6, wp.atan2(size, wp.dot(za, zb)) / wp.max(size, 1.0e-6), 1.0)
    q = wp.quat_inverse(b) * a
    if q[3] < 0.0:
        q = -q
    v = wp.vec3(q[0], q[1], q[2])
    size = wp.length(v)
    return v[i] * wp.where(size > 1.0e-6, 2.0 * wp.atan2(size, q[3]) / wp.max(size, 1.0e-6), 2.0)
