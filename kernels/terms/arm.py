# SPDX-License-Identifier: Apache-2.0
"""Cost terms of an arm (Bhardwaj et al., STORM, CoRL 2021). See ``general`` for their signature."""

import warp as wp

from ..geometry.jacobian import Chain, jacobian_column, manipulability_of, solve_damped
from .view import (
    StepView,
    control,
    frame_angular_velocity,
    frame_pose,
    frame_position,
    frame_start,
    frame_velocity,
    joint_position,
    joint_velocity,
    step_length,
)

wp.set_module_options({"enable_backward": False})


@wp.struct
class PoseParams:
    """Parameters of ``pose``."""

    of: int
    to: int
    position: wp.vec3  # [1/m] weights along the axes of the second frame
    rotation: wp.vec3  # weights of these axes' own errors
    planar: int  # the second frame has no height


@wp.func
def pose(s: StepView, p: PoseParams) -> float:
    """Error of a pose, Σ r_i ‖row i of I - R_gᵀR‖ + ‖p_w ⊙ R_gᵀ(p - p_g)‖ (STORM), axes and directions weighted apart.

    Row i is by how much axis i of the goal g, seen from the frame, misses its place: 2 sin(θ/2) for an angle θ.
    """
    a = frame_pose(s, p.of)
    g = frame_pose(s, p.to)
    turn = wp.transform_get_rotation(g)
    d = wp.transform_get_translation(a) - wp.transform_get_translation(g)
    if p.planar != 0:
        d[2] = 0.0
    total = wp.length(wp.cw_mul(p.position, wp.quat_rotate_inv(turn, d)))
    # row i of I - R_gᵀR is as long as R e_i - R_g e_i
    miss = wp.quat_to_matrix(wp.transform_get_rotation(a)) - wp.quat_to_matrix(turn)
    for i in range(3):
        total += p.rotation[i] * wp.length(wp.vec3(miss[0, i], miss[1, i], miss[2, i]))
    return total


@wp.struct
class StopParams:
    """Parameters of ``stop``."""

    joint: wp.array[int]  # joint velocities
    acceleration: wp.array[float]  # [m/s² or rad/s²] greatest of each


@wp.func
def stop(s: StepView, p: StopParams) -> float:
    """Σ max(0, |q̇| - v_h)² with v_h = a_max Σ_{k≥h} dt_k, from which a joint still stops within the horizon (STORM).

    That is STORM's Eq. 9, in [m²/s² or rad²/s²]. Step h, which led here, counts among those that are left, so that
    the end of the horizon allows what one last step could stop.
    """
    left = s.step_end[s.step_end.shape[0] - 1] - s.step_end[s.t - 1]
    total = float(0.0)
    for i in range(p.joint.shape[0]):
        beyond = wp.max(wp.abs(joint_velocity(s, p.joint[i])) - left * p.acceleration[i], 0.0)
        total += beyond * beyond
    return total


@wp.struct
class ManipulabilityParams:
    """Parameters of ``manipulability``."""

    of: int
    chain: Chain
    least: float  # k_m, of the measure √det(J Jᵀ)
    step: int  # the paper's 1 - m below k_m, instead of its code's ramp


@wp.func
def manipulability(s: StepView, p: ManipulabilityParams) -> float:
    """max(0, (k_m - m)/k_m) for the manipulability m = √det(J Jᵀ) of a frame (STORM's code), or 1 - m where m < k_m.

    The latter is the paper's form (Eq. 10). Chains of fewer than six joint axes have √det(Jᵀ J).
    """
    m = manipulability_of(p.chain, frame_position(s, p.of), s.joint_q, s.body_q, s.t, s.w)
    if p.step != 0:
        return wp.where(m < p.least, 1.0 - m, 0.0)
    return wp.max((p.least - m) / p.least, 0.0)


@wp.func
def joint_acceleration(s: StepView, joint: int, driven: int) -> float:
    """Mean acceleration of a joint velocity over the step that led here [m/s² or rad/s²].

    For a joint whose drive takes accelerations that is its control ``driven``, else -1 and differences of velocities.
    """
    if driven >= 0:
        return control(s, driven)
    return (joint_velocity(s, joint) - s.joint_qd[s.t - 1, s.w, joint]) / step_length(s)


@wp.func
def joint_jerk(s: StepView, joint: int, driven: int) -> float:
    """Change of a joint's acceleration from the step before to this one, per time between their middles.

    Before the first step stands the control that acts now; without drives of accelerations it is 0 there, since
    nothing is known from before.
    """
    now = joint_acceleration(s, joint, driven)
    dt = step_length(s)
    if s.t == 1:
        if driven < 0:
            return 0.0
        return (now - s.last_control[s.e, driven]) / dt
    earlier = s.step_end[s.t - 1] - s.step_end[s.t - 2]
    before = float(0.0)
    if driven >= 0:
        before = s.controls[s.t - 2, s.w, driven]
    else:
        before = (s.joint_qd[s.t - 1, s.w, joint] - s.joint_qd[s.t - 2, s.w, joint]) / earlier
    return 2.0 * (now - before) / (dt + earlier)


@wp.func
def outside(value: float, bound: float) -> float:
    """Squared distance of a value outside ± a bound."""
    d = wp.max(wp.abs(value) - bound, 0.0)
    return d * d


@wp.struct
class JointBoundsParams:
    """Parameters of ``joint_bounds``: limits by joint, shrunk; infinite where there are none."""

    joint: wp.array[int]  # joint velocities
    coord: wp.array[int]  # joint coordinates
    driven: wp.array[int]  # control that is the joint's acceleration, or -1
    middle: wp.array[float]  # [m or rad] of the range of positions
    reach: wp.array[float]  # [m or rad] to either side of it
    velocity: wp.array[float]  # [m/s or rad/s]
    acceleration: wp.array[float]  # [m/s² or rad/s²]
    jerk: wp.array[float]  # [m/s³ or rad/s³]


@wp.func
def joint_bounds(s: StepView, p: JointBoundsParams) -> float:
    """Squared distance of joint positions, velocities, accelerations and jerks outside their limits (STORM), shrunk.

    The sum is over joints and kinds, each in the square of its own unit. Accelerations and jerks are differences of
    the velocities at the ends of steps, or controls where a drive takes accelerations.
    """
    total = float(0.0)
    for i in range(p.joint.shape[0]):
        joint = p.joint[i]
        total += outside(joint_position(s, p.coord[i]) - p.middle[i], p.reach[i])
        total += outside(joint_velocity(s, joint), p.velocity[i])
        total += outside(joint_acceleration(s, joint, p.driven[i]), p.acceleration[i])
        total += outside(joint_jerk(s, joint, p.driven[i]), p.jerk[i])
    return total


@wp.struct
class SmoothnessParams:
    """Parameters of ``smoothness``."""

    joint: wp.array[int]  # joint velocities
    driven: wp.array[int]  # control that is the joint's acceleration, or -1
    acceleration: float  # factors
    jerk: float


@wp.func
def smoothness(s: StepView, p: SmoothnessParams) -> float:
    """Σ α q̈² + ζ q⃛² over joints, with accelerations and jerks as in ``joint_bounds``."""
    total = float(0.0)
    for i in range(p.joint.shape[0]):
        a = joint_acceleration(s, p.joint[i], p.driven[i])
        j = joint_jerk(s, p.joint[i], p.driven[i])
        total += p.acceleration * a * a + p.jerk * j * j
    return total


@wp.struct
class NullPostureParams:
    """Parameters of ``null_posture``."""

    of: int
    chain: Chain
    target: wp.array[float]  # [m or rad] wanted posture, by column of the chain
    damping: float  # square of the singular value at which a direction is given up half


@wp.func
def null_posture(s: StepView, p: NullPostureParams) -> float:
    """‖(I - J⁺J)(q - q₀)‖²: how far a posture is from q₀ that the frame's pose does not ask for [rad² or m²].

    STORM's null-space term, which its code leaves unprojected as ``posture`` does. J⁺ = Jᵀ(J Jᵀ + λ²I)⁻¹, damped, so
    that near a singular posture the direction that is lost goes over to the null space gradually.
    """
    at = frame_position(s, p.of)
    n = p.chain.column.shape[0]
    gram = wp.spatial_matrix(0.0)
    moved = wp.spatial_vector()
    for i in range(n):
        column = jacobian_column(p.chain, i, at, s.joint_q, s.body_q, s.t, s.w)
        gram += wp.outer(column, column)
        moved += column * (joint_position(s, p.chain.coord[p.chain.column[i]]) - p.target[i])
    x = solve_damped(gram, p.damping, moved)
    total = float(0.0)
    for i in range(n):
        column = jacobian_column(p.chain, i, at, s.joint_q, s.body_q, s.t, s.w)
        d = joint_position(s, p.chain.coord[p.chain.column[i]]) - p.target[i] - wp.dot(column, x)
        total += d * d
    return total


@wp.struct
class PathDeviationParams:
    """Parameters of ``path_deviation``."""

    of: int
    to: int
    start: int  # frame, or -1 for where the first one was when the rollout began
    planar: int  # one of its ends has no height


@wp.func
def path_deviation(s: StepView, p: PathDeviationParams) -> float:
    """Distance of a frame from the straight line between two places [m]: ‖p - (a + λ (b - a))‖, least in λ ∈ [0, 1].

    The line ends at frame b and begins at frame a, or where the frame itself was when the rollout began.
    """
    at = frame_position(s, p.of)
    a = wp.vec3(0.0)
    if p.start >= 0:
        a = frame_position(s, p.start)
    else:
        a = frame_start(s, p.of)
    way = frame_position(s, p.to) - a
    gone = at - a
    if p.planar != 0:
        gone[2] = 0.0
        way[2] = 0.0
    share = wp.clamp(wp.dot(gone, way) / wp.max(wp.length_sq(way), 1.0e-12), 0.0, 1.0)
    return wp.length(gone - share * way)


@wp.struct
class SpeedParams:
    """Parameters of ``speed``."""

    of: int
    linear: float  # [m/s]
    angular: float  # [rad/s]


@wp.func
def speed(s: StepView, p: SpeedParams) -> float:
    """max(0, ‖v‖ - v_max)² + max(0, ‖ω‖ - ω_max)² of a frame's velocity [m²/s², rad²/s²]."""
    linear = outside(wp.length(frame_velocity(s, p.of)), p.linear)
    return linear + outside(wp.length(frame_angular_velocity(s, p.of)), p.angular)
