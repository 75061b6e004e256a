# SPDX-License-Identifier: Apache-2.0
"""What a cost term sees: one step of one rollout, and the functions that read it."""

import warp as wp

from ..geometry.fields import sample_field

wp.set_module_options({"enable_backward": False})

GOAL_BODY = wp.constant(-2)


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
    goal: wp.array[wp.transform]  # [E]
    frame_body: wp.array[int]  # [nf] body, -1 world, -2 goal
    frame_pose: wp.array[wp.transform]  # [nf] in the body's frame
    field: wp.array3d[float]  # [E·F, rows, columns] distance fields
    field_center: wp.array[wp.vec2]  # [E·F] point that each field measures the distance to
    field_origin: wp.vec2
    field_cell: float
    fields: int  # F per environment


@wp.func
def frame_pose(s: StepView, frame: int) -> wp.transform:
    """World pose of a frame at this step."""
    body = s.frame_body[frame]
    if body == GOAL_BODY:
        return s.goal[s.e] * s.frame_pose[frame]
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
def frame_velocity(s: StepView, frame: int) -> wp.vec3:
    """World velocity [m/s] of the centre of mass of a frame's body; zero for fixed frames."""
    body = s.frame_body[frame]
    if body < 0:
        return wp.vec3(0.0)
    return wp.spatial_top(s.body_qd[s.t, s.w, body])


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
def plane_distance(s: StepView, field: int, target: wp.vec2, p: wp.vec2) -> float:
    """Distance in the ground plane, straight or along the shortest path around the obstacles.

    The field holds the path length to where the target was when the plan started. What it exceeds the straight
    line by is the detour at p; the target may move during the horizon, so the detour is added to the straight
    distance to where it is now.
    """
    straight = wp.length(p - target)
    if field < 0:
        return straight
    f = s.e * s.fields + field
    path = sample_field(s.field, f, s.field_origin, s.field_cell, p)
    # between cells the field is interpolated, which adds a little near the target
    return straight + wp.max(path - wp.length(p - s.field_center[f]) - 0.25 * s.field_cell, 0.0)
