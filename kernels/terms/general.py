# SPDX-License-Identifier: Apache-2.0
"""Cost terms: one Warp function each, over one step of one world.

Every term has the signature ``(s: StepView, p: Params) -> float``. ``s`` is one step of one rollout, read with the
functions of ``view``; ``p`` holds the term's parameters. Weights are applied by the kernel that calls the term (see
``warpmpc.cost.term``). Terms that push an object are in ``pushing``, those that pick one up in ``grasping``, those
about obstacles and outlines in ``clearance``.
"""

import warp as wp

from .paths import PathFields, plane_distance
from .view import (
    StepView,
    contact_force,
    control,
    frame_pose,
    frame_position,
    frame_rotation,
    frame_velocity,
    joint_position,
    joint_velocity,
    rotation_angle,
    wrap_angle,
    yaw,
)

wp.set_module_options({"enable_backward": False})


@wp.struct
class DistanceParams:
    """Parameters of ``distance``."""

    first: int
    second: int
    planar: int  # compare x and y alone
    field: int  # distance field, -1 for the straight line
    paths: PathFields
    near: float  # [m] saturate: 1 - exp(-d/near) instead of d; 0 means d itself
    lead: float  # [s] measure from where the first frame would coast to in this time


@wp.func
def distance(s: StepView, p: DistanceParams) -> float:
    """Distance between two frames, ‖p_a - p_b‖ (Pezzato et al. 2025, Eq. 10), straight or along the geodesic [m].

    With ``near`` it saturates, 1 - exp(-d/near): a pull that acts close to the target alone. With ``lead`` it is
    measured from p_a + lead · ṗ_a, so that what rolls or slides on after the horizon is seen to do so.
    """
    a = frame_position(s, p.first)
    if p.lead != 0.0:
        a += p.lead * frame_velocity(s, p.first)
    b = frame_position(s, p.second)
    d = wp.length(a - b)
    if p.planar != 0:
        d = plane_distance(s, p.paths, p.field, wp.vec2(b[0], b[1]), wp.vec2(a[0], a[1]))
    if p.near > 0.0:
        return 1.0 - wp.exp(-d / p.near)
    return d


@wp.struct
class YawParams:
    """Parameters of ``yaw``."""

    of: int
    to: int
    near: float  # [m] the term fades with distance beyond about this; 0 means everywhere
    smooth: float  # [rad] √(ψ² + p²) - p instead of |ψ|: quadratic below about p


@wp.func
def yaw_error(s: StepView, p: YawParams) -> float:
    """Heading error |ψ_a - ψ_b| on the circle (Eq. 10), optionally fading with the distance to the target.

    With ``smooth`` the error counts by MuJoCo MPC's SmoothAbs norm (Howell et al. 2022): small errors cost little.
    """
    a = frame_pose(s, p.of)
    b = frame_pose(s, p.to)
    error = wp.abs(wrap_angle(yaw(wp.transform_get_rotation(a)) - yaw(wp.transform_get_rotation(b))))
    error = wp.sqrt(error * error + p.smooth * p.smooth) - p.smooth
    if p.near > 0.0:
        d = wp.transform_get_translation(a) - wp.transform_get_translation(b)
        error *= wp.exp(-wp.length(wp.vec2(d[0], d[1])) / p.near)
    return error


@wp.struct
class ContactForceParams:
    """Parameters of ``contact_force``."""

    first: int  # first watched pair
    count: int


@wp.func
def contact_cost(s: StepView, p: ContactForceParams) -> float:
    """Σ ‖F‖ over watched pairs (Eq. 7) [N]."""
    total = float(0.0)
    for i in range(p.count):
        total += wp.length(contact_force(s, p.first + i))
    return total


@wp.struct
class ControlParams:
    """Parameters of ``control_effort`` and ``control_rate``: a range of controls."""

    first: int
    count: int


@wp.func
def control_effort(s: StepView, p: ControlParams) -> float:
    """Σ (u_i / half range)²."""
    total = float(0.0)
    for i in range(p.first, p.first + p.count):
        u = control(s, i) / s.control_scale[i]
        total += u * u
    return total


@wp.func
def control_rate(s: StepView, p: ControlParams) -> float:
    """Σ ((u_i - previous u_i) / half range)²; before the first step stands the control that acts now."""
    total = float(0.0)
    for i in range(p.first, p.first + p.count):
        before = s.last_control[s.e, i]
        if s.t > 1:
            before = s.controls[s.t - 2, s.w, i]
        du = (control(s, i) - before) / s.control_scale[i]
        total += du * du
    return total


@wp.struct
class JointLimitParams:
    """Parameters of ``joint_limit``."""

    coord: wp.array[int]  # limited joint coordinates
    lower: wp.array[float]  # [m or rad] limits moved inwards by the margin
    upper: wp.array[float]


@wp.func
def joint_limit(s: StepView, p: JointLimitParams) -> float:
    """Squared distance of joint positions outside their limits, the limits moved inwards by a margin (STORM)."""
    total = float(0.0)
    for i in range(p.coord.shape[0]):
        q = joint_position(s, p.coord[i])
        outside = wp.max(wp.max(p.lower[i] - q, q - p.upper[i]), 0.0)
        total += outside * outside
    return total


@wp.struct
class JointVelocityParams:
    """Parameters of ``joint_velocity``."""

    joint: wp.array[int]  # joint velocities


@wp.func
def joint_velocity_cost(s: StepView, p: JointVelocityParams) -> float:
    """Σ q̇²."""
    total = float(0.0)
    for i in range(p.joint.shape[0]):
        total += joint_velocity(s, p.joint[i]) * joint_velocity(s, p.joint[i])
    return total


@wp.struct
class PostureParams:
    """Parameters of ``posture``."""

    coord: wp.array[int]  # joint coordinates
    target: wp.array[float]  # [m or rad]


@wp.func
def posture(s: StepView, p: PostureParams) -> float:
    """Σ (q - q₀)² with the scene's starting posture q₀ (STORM's null-space cost)."""
    total = float(0.0)
    for i in range(p.coord.shape[0]):
        d = joint_position(s, p.coord[i]) - p.target[i]
        total += d * d
    return total


@wp.struct
class HeightParams:
    """Parameters of ``height``."""

    of: int
    target: float  # [m]
    slack: float  # [m] errors up to this cost nothing


@wp.func
def height(s: StepView, p: HeightParams) -> float:
    """|z - target| of a frame (Pezzato et al. 2025, C_ee) [m], or what it exceeds ``slack`` by."""
    return wp.max(wp.abs(frame_position(s, p.of)[2] - p.target) - p.slack, 0.0)


@wp.struct
class OrientationParams:
    """Parameters of ``orientation``."""

    of: int
    to: int
    tilt: int  # compare the directions of the z axes alone


@wp.func
def orientation(s: StepView, p: OrientationParams) -> float:
    """Angle between the orientations of two frames, or between their z axes [rad]."""
    a = frame_rotation(s, p.of)
    b = frame_rotation(s, p.to)
    if p.tilt == 0:
        return rotation_angle(a, b)
    za = wp.quat_rotate(a, wp.vec3(0.0, 0.0, 1.0))
    zb = wp.quat_rotate(b, wp.vec3(0.0, 0.0, 1.0))
    return wp.atan2(wp.length(wp.cross(za, zb)), wp.dot(za, zb))
