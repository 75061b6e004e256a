# SPDX-License-Identifier: Apache-2.0
"""A ball that rolls on a tray: motion of its own that costs depend on (Bhardwaj et al. 2021, Fig. 6)."""

from typing import Any

import numpy as np
import warp as wp

from ...kernels.cost.view import (
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
from ...kernels.geometry.kinematics import FREE
from ...scene.types import Flag, NonNegative, Positive
from ..binding import Binding
from ..keys import Frame, Object, TermKeys, term


class RollingBall(TermKeys):
    """Squared distance of a rolling ball from the origin of a frame, by its own motion."""

    ball: Object
    """Object that rolls; it starts where it is observed."""
    on: Frame
    """Frame on whose plane z = 0 it rolls; the origin is where the ball belongs."""
    share: Positive = 5.0 / 7.0
    """Share of the acceleration that a frictionless point would have; 5/7 for a solid ball, 1 in STORM."""
    carried: Flag = True
    """Count the frame's own acceleration, too; not in STORM."""
    time: NonNegative = 0.5
    """How long of its way counts as distance when the ball moves [s]."""

    derived = {
        "memory": int,  # first of four numbers: place [m] and velocity [m/s] of the ball in x and y of the frame
        "velocity": int,  # first joint velocity of the ball, which is free
        "carried": float,  # 1 if the frame's own acceleration counts, else 0
        "gravity": wp.vec3,  # [m/s²]
    }

    def bind(self, p: Any, b: Binding) -> None:
        """Find the ball's joint, and room for its motion."""
        shape, layout = b.object_shape(self.ball, "ball"), b.layout
        if shape.kind != "sphere":
            raise b.error("only spheres roll like this", "ball", found=shape.kind)
        joint = int(np.flatnonzero(layout.joint_child == shape.body)[0])
        if int(layout.joint_type[joint]) != int(FREE):
            raise b.error("this object does not move freely", "ball", found=self.ball)
        p.memory = b.carry(4)
        p.velocity = int(layout.joint_qd_start[joint])
        p.carried, p.gravity = float(self.carried), wp.vec3(*layout.gravity)


@wp.func
def roll(s: StepView, p: RollingBall.Params):
    """Move the ball on: v̇ = share · (Rᵀ(g - a))_xy, g gravity, a the acceleration of the frame."""
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
        pull = p.gravity * dt
        pull -= p.carried * (frame_velocity(s, p.on) - frame_velocity(step_before(s), p.on))
        gain = p.share * wp.quat_rotate_inv(rotation, pull)
        for k in range(2):
            speed_k = memory_before(s, i + 2 + k) + gain[k]
            remember(s, i + 2 + k, speed_k)
            remember(s, i + k, memory_before(s, i + k) + dt * speed_k)


@term("rolling_ball", RollingBall, advance=roll)
def rolling_ball(s: StepView, p: RollingBall.Params) -> float:
    """Distance and speed of a ball that rolls on a tray, ‖p‖² + (time · ‖v‖)² [m²]."""
    i = p.memory
    near = memory(s, i) * memory(s, i) + memory(s, i + 1) * memory(s, i + 1)
    fast = memory(s, i + 2) * memory(s, i + 2) + memory(s, i + 3) * memory(s, i + 3)
    return near + p.time * p.time * fast
