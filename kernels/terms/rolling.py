# SPDX-License-Identifier: Apache-2.0
"""A ball that rolls on a tray: motion of its own that costs depend on (Bhardwaj et al. 2021, Fig. 6)."""

import warp as wp

from .view import (
    StepView,
    frame_angular_velocity,
    frame_position,
    frame_rotation,
    frame_velocity,
    memory,
    memory_before,
    remember,
    step_before,
    step_length,
)

wp.set_module_options({"enable_backward": False})


@wp.struct
class RollingBallParams:
    """A ball and the plane z = 0 of a frame."""

    memory: int  # first of four numbers: place [m] and velocity [m/s] of the ball in x and y of the frame
    ball: int  # frame
    velocity: int  # first joint velocity of the ball, which is free
    on: int  # frame
    share: float  # of the acceleration that a frictionless point would have
    carried: float  # 1 if the frame's own acceleration counts, else 0
    gravity: float  # [m/s²]
    time: float  # [s] how long of its way the ball's velocity counts as distance


@wp.func
def roll(s: StepView, p: RollingBallParams):
    """Move the ball on: v̇ = share · (Rᵀ(g - a))_xy, g along -z of the world, a the acceleration of the frame."""
    rotation = frame_rotation(s, p.on)
    i = p.memory
    if s.t == 0:
        away = frame_position(s, p.ball) - frame_position(s, p.on)
        j = p.velocity
        speed = wp.vec3(s.joint_qd[0, s.w, j], s.joint_qd[0, s.w, j + 1], s.joint_qd[0, s.w, j + 2])
        speed -= frame_velocity(s, p.on) + wp.cross(frame_angular_velocity(s, p.on), away)
        place = wp.quat_rotate_inv(rotation, away)
        velocity = wp.quat_rotate_inv(rotation, speed)
        remember(s, i, place[0])
        remember(s, i + 1, place[1])
        remember(s, i + 2, velocity[0])
        remember(s, i + 3, velocity[1])
    else:
        dt = step_length(s)
        pull = wp.vec3(0.0, 0.0, -p.gravity * dt)
        pull -= p.carried * (frame_velocity(s, p.on) - frame_velocity(step_before(s), p.on))
        gain = p.share * wp.quat_rotate_inv(rotation, pull)
        for k in range(2):
            speed_k = memory_before(s, i + 2 + k) + gain[k]
            remember(s, i + 2 + k, speed_k)
            remember(s, i + k, memory_before(s, i + k) + dt * speed_k)


@wp.func
def rolling_ball(s: StepView, p: RollingBallParams) -> float:
    """‖p‖² + (time · ‖v‖)² [m²]."""
    i = p.memory
    near = memory(s, i) * memory(s, i) + memory(s, i + 1) * memory(s, i + 1)
    fast = memory(s, i + 2) * memory(s, i + 2) + memory(s, i + 3) * memory(s, i + 3)
    return near + p.time * p.time * fast
