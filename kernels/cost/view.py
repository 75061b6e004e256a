# SPDX-License-Identifier: Apache-2.0
"""View of a cost term: one step of one rollout, and the functions that read it."""

import warp as wp

wp.set_module_options({"enable_backward": False})

TASK_BODY = wp.constant(-2)
"""Body of frames that are poses of the task: this one for the first (the goal), -3 for the second, and so on."""


@wp.struct
class StepView:
    """One step of one rollout: everything a cost term may look at."""

    t: int  # slice of the state arrays, 1..T: the state after t controls
    w: int  # world
    e: int  # environment
    joint_q: wp.array3d[float]  # [T+1, W, nq]
    joint_qd: wp.array3d[float]  # [T+1, W, nv]
    body_q: wp.array3d[wp.transform]  # [T+1, W, nb]
    body_qd: wp.array3d[wp.spatial_vector]  # [T+1, W, nb]
    force: wp.array3d[wp.vec3]  # [T, W, pair] [N]
    sensor: wp.array3d[float]  # [T, W, ns]
    controls: wp.array3d[float]  # [T, W, nu]
    last_control: wp.array2d[float]  # [E, nu] control that acts when the plan starts
    control_scale: wp.array[float]  # [nu] half range of each control
    start: wp.array[float]  # [E] time of the observed state [s]
    step_end: wp.array[float]  # [T+1] time of each slice after the observed state [s]
    pose: wp.array2d[wp.transform]  # [E, poses] of the task, the goal first
    scalar: wp.array2d[float]  # [E, scalars] of the task
    frame_body: wp.array[int]  # [nf] body, -1 world, -2 and below poses of the task
    frame_pose: wp.array[wp.transform]  # [nf] in the body's frame
    body_com: wp.array[wp.vec3]  # [nb] centre of mass in the body's frame [m]
    body_mass: wp.array[float]  # [nb] [kg]
    body_robot: wp.array[int]  # [nb] number of the robot or object it belongs to
    memory: wp.array3d[float]  # [T+1, W, nx] numbers that terms carry along the rollouts


@wp.func
def frame_pose(s: StepView, frame: int) -> wp.transform:
    """World pose of a frame at this step."""
    body = s.frame_body[frame]
    if body <= TASK_BODY:
        return s.pose[s.e, TASK_BODY - body] * s.frame_pose[frame]
    if body < 0:
        return s.frame_pose[frame]
    return s.body_q[s.t, s.w, body] * s.frame_pose[frame]


@wp.func
def frame_position(s: StepView, frame: int) -> wp.vec3:
    """World position of a frame at this step [m]."""
    return wp.transform_get_translation(frame_pose(s, frame))


@wp.func
def frame_rotation(s: StepView, frame: int) -> wp.quat:
    """World orientation of a frame at this step."""
    return wp.transform_get_rotation(frame_pose(s, frame))


@wp.func
def frame_start(s: StepView, frame: int) -> wp.vec3:
    """World position of a frame when the rollout began [m]; poses of the task are where they are now."""
    body = s.frame_body[frame]
    if body < 0:
        return frame_position(s, frame)
    return wp.transform_get_translation(s.body_q[0, s.w, body] * s.frame_pose[frame])


@wp.func
def frame_velocity(s: StepView, frame: int) -> wp.vec3:
    """World velocity of a frame's origin [m/s]; zero for fixed frames."""
    body = s.frame_body[frame]
    if body < 0:
        return wp.vec3(0.0)
    pose = s.body_q[s.t, s.w, body]
    twist = s.body_qd[s.t, s.w, body]
    arm = wp.quat_rotate(
        wp.transform_get_rotation(pose), wp.transform_get_translation(s.frame_pose[frame]) - s.body_com[body]
    )
    return wp.spatial_top(twist) + wp.cross(wp.spatial_bottom(twist), arm)


@wp.func
def frame_angular_velocity(s: StepView, frame: int) -> wp.vec3:
    """World angular velocity of a frame [rad/s]; zero for fixed frames."""
    body = s.frame_body[frame]
    if body < 0:
        return wp.vec3(0.0)
    return wp.spatial_bottom(s.body_qd[s.t, s.w, body])


@wp.func
def centre_of_mass(s: StepView, robot: int) -> wp.vec3:
    """Centre of mass of a robot or an object [m], by the scene's masses."""
    total = float(0.0)
    moment = wp.vec3(0.0)
    for body in range(s.body_mass.shape[0]):
        if s.body_robot[body] == robot:
            total += s.body_mass[body]
            moment += s.body_mass[body] * wp.transform_point(s.body_q[s.t, s.w, body], s.body_com[body])
    return moment / total


@wp.func
def centre_of_mass_velocity(s: StepView, robot: int) -> wp.vec3:
    """Velocity of that centre of mass [m/s]."""
    total = float(0.0)
    momentum = wp.vec3(0.0)
    for body in range(s.body_mass.shape[0]):
        if s.body_robot[body] == robot:
            total += s.body_mass[body]
            momentum += s.body_mass[body] * wp.spatial_top(s.body_qd[s.t, s.w, body])
    return momentum / total


@wp.func
def memory(s: StepView, i: int) -> float:
    """Number i of those that terms carry along the rollout, at this step."""
    return s.memory[s.t, s.w, i]


@wp.func
def memory_before(s: StepView, i: int) -> float:
    """The same number one step before."""
    return s.memory[s.t - 1, s.w, i]


@wp.func
def remember(s: StepView, i: int, value: float):
    """Set number i of this step; for functions that carry numbers along."""
    s.memory[s.t, s.w, i] = value


@wp.func
def step_before(s: StepView) -> StepView:
    """The same rollout one step before."""
    before = s
    before.t = s.t - 1
    return before


@wp.func
def step_time(s: StepView) -> float:
    """Time of this step [s], on the clock of the observations."""
    return s.start[s.e] + s.step_end[s.t]


@wp.func
def step_length(s: StepView) -> float:
    """Time for which the control that led to this step was held [s]."""
    return s.step_end[s.t] - s.step_end[s.t - 1]


@wp.func
def task_scalar(s: StepView, i: int) -> float:
    """Scalar i of the task, such as a wanted speed."""
    return s.scalar[s.e, i]


@wp.func
def joint_position(s: StepView, i: int) -> float:
    """Joint coordinate i at this step [m or rad]."""
    return s.joint_q[s.t, s.w, i]


@wp.func
def joint_velocity(s: StepView, i: int) -> float:
    """Joint velocity i at this step [m/s or rad/s]."""
    return s.joint_qd[s.t, s.w, i]


@wp.func
def control(s: StepView, i: int) -> float:
    """Control i that led to this step."""
    return s.controls[s.t - 1, s.w, i]


@wp.func
def contact_force(s: StepView, pair: int) -> wp.vec3:
    """Net contact force of a watched pair during the control that led to this step [N]."""
    return s.force[s.t - 1, s.w, pair]


@wp.func
def sensor(s: StepView, i: int) -> float:
    """Number i of the sensors' at the end of the control that led to this step, in the sensor's own unit."""
    return s.sensor[s.t - 1, s.w, i]


@wp.func
def yaw(q: wp.quat) -> float:
    """Heading of a rotation about z, in (-π, π]."""
    return wp.atan2(2.0 * (q[3] * q[2] + q[0] * q[1]), 1.0 - 2.0 * (q[1] * q[1] + q[2] * q[2]))


@wp.func
def wrap_angle(a: float) -> float:
    """The same angle in (-π, π]."""
    return wp.atan2(wp.sin(a), wp.cos(a))


@wp.func
def rotation_angle(a: wp.quat, b: wp.quat) -> float:
    """Angle between two orientations, in [0, π]."""
    d = wp.quat_inverse(a) * b
    return 2.0 * wp.atan2(wp.length(wp.vec3(d[0], d[1], d[2])), wp.abs(d[3]))


@wp.func
def frame_acceleration(s: StepView, frame: int) -> wp.vec3:
    """Mean acceleration of a frame's origin over the step that led here, in the world [m/s²]; zero for fixed frames.

    J q̈ + J̇ q̇ of the middle of the step, to second order of its length (Bhardwaj et al. 2021, Eq. 8). The observed
    state has none.
    """
    return (frame_velocity(s, frame) - frame_velocity(step_before(s), frame)) / step_length(s)


@wp.func
def frame_angular_acceleration(s: StepView, frame: int) -> wp.vec3:
    """Mean angular acceleration of a frame over the step that led here, in the world [rad/s²]; zero for fixed ones."""
    return (frame_angular_velocity(s, frame) - frame_angular_velocity(step_before(s), frame)) / step_length(s)


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
