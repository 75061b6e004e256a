# SPDX-License-Identifier: Apache-2.0
"""Values that a term reads of a step, from registers; ``view_NAME`` stands for that function of ``terms.view``."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp

from ...physics.runtime import bake
from .functions import Functions
from .values import Num, PoseSymbol, Refused, Rot, Step, Time, Vec, constant, plain, value

BY_STEP = ("body_q", "body_qd", "joint_q", "joint_qd", "controls", "force", "sensor")


class Accessors(Functions):
    """Writes what is read of a step, by what the state has in registers."""

    def earlier(self, x: Any, step: Step) -> Any:
        """Return the value that something of the state had in another step.

        Raises:
            Refused: If that is more than one step before.
        """
        if step.back == 0:
            return x
        if step.back != 1:
            raise Refused(f"a state {step.back} steps before")
        if isinstance(x, PoseSymbol):
            return PoseSymbol(self.earlier(self.rot(x), step), self.earlier(self.pos(x), step))
        if isinstance(x, Rot):
            return Rot(tuple(tuple(self.earlier(y, step) for y in column) for column in x.columns))
        if isinstance(x, Vec):
            return Vec(tuple(self.earlier(y, step) for y in x.x))
        return x if plain(x) else Num(self.state.before(x.text))

    def _frame(self, frame: int) -> PoseSymbol:
        code = self.state.frame(frame)
        return PoseSymbol(self.rotation(code.columns), self.vector(code.position))

    def view_frame_pose(self, s: Step, frame: int) -> PoseSymbol:
        return self.earlier(self._frame(frame), s)

    def view_frame_position(self, s: Step, frame: int) -> Vec:
        return self.earlier(self._frame(frame).pos, s)

    def view_frame_rotation(self, s: Step, frame: int) -> Rot:
        return self.earlier(self._frame(frame).rot, s)

    def view_frame_start(self, s: Step, frame: int) -> Vec:
        return self.vector(self.state.at_start(x) for x in self.state.frame(frame).position)

    def view_frame_velocity(self, s: Step, frame: int) -> Vec:
        return self.earlier(self.vector(self.state.velocity(frame)[0]), s)

    def view_frame_angular_velocity(self, s: Step, frame: int) -> Vec:
        return self.earlier(self.vector(self.state.velocity(frame)[1]), s)

    def view_joint_position(self, s: Step, i: int) -> Any:
        return self.earlier(self.symbol(self.state.coordinate(i)), s)

    def view_joint_velocity(self, s: Step, i: int) -> Any:
        return self.earlier(self.symbol(self.state.speed(i)), s)

    def view_control(self, s: Step, i: int) -> Num:
        if s.back not in (0, 1):
            raise Refused(f"a control {s.back} steps before")
        return Num(f"{'cd'[s.back]}{i}")

    def view_sensor(self, s: Step, i: int) -> Any:
        if s.back:
            raise Refused("a sensor one step before")
        return self.symbol(self.state.sensor(i))

    def view_task_scalar(self, s: Step, i: int) -> Num:
        return Num(self.state.scalar(i))

    def view_contact_force(self, s: Step, pair: int) -> Vec:
        if s.back:
            raise Refused("a contact force one step before")
        return self.vector(self.state.force(pair))

    def view_step_before(self, s: Step) -> Step:
        return Step(s.back + 1)

    def view_memory(self, s: Step, i: int) -> Num:
        raise Refused("numbers that a term carries along")

    view_memory_before = view_memory

    def view_yaw(self, q: Rot) -> Any:
        return self.wp_atan2(q.columns[0][1], q.columns[0][0])

    def view_rotation_angle(self, a: Rot, b: Rot) -> Any:
        """Twice the angle whose sine is that of half the turn: Σ ‖R_a e_i - R_b e_i‖² = 8 sin²(θ/2)."""
        pairs = zip(a.columns, b.columns, strict=True)
        miss = Vec(tuple(d for x, y in pairs for d in self.binary("-", Vec(x), Vec(y)).x))
        squared = self.binary("*", 0.125, self.dot(miss, miss))
        cosine = self.wp_sqrt(self.wp_max(self.binary("-", 1.0, squared), 0.0))
        half = self.defined(bake.angle, self.lanes(self.wp_sqrt(squared)), self.lanes(cosine))
        return self.binary("*", 2.0, half)

    def view_wrap_angle(self, a: Any) -> Any:
        turns = self.wp_rint(self.binary("*", a, 0.5 / math.pi))
        return self.sum(self.operand(a), (-2.0 * math.pi, self.operand(turns)))

    def point_velocity(self, s: Step, body: int, at: Vec) -> Vec:
        """``points.point_velocity``."""
        fixed = [value(x) for x in at.x]
        if None in fixed:
            raise Refused("the velocity of a point that is not known")
        return self.earlier(self.vector(self.state.point_velocity(body, np.array(fixed, dtype=float))[0]), s)

    def view_joint_acceleration(self, s: Step, joint: int, driven: int) -> Any:
        return self.symbol(self.state.acceleration(joint))

    def view_joint_jerk(self, s: Step, joint: int, driven: int) -> Any:
        now, then = self.state.acceleration(joint), self.state.acceleration_before(joint)
        return self.binary("/", self.binary("-", self.symbol(now), self.symbol(then)), Num("gap", "S"))

    def states(self, name: str, index: tuple) -> Any:
        """Write an entry of an array of the view.

        Raises:
            Refused: If the launch does not have it.
        """
        step = Step(index[0].back) if isinstance(index[0], Time) else None
        if step is None and name in BY_STEP:
            raise Refused(f"s.{name} at a fixed step")
        last = index[-1]
        if name in ("control_scale", "step_end", "start"):
            return Num(f"s.{name}.data[{self.raw(last)}]", "S")
        if not plain(last):
            raise Refused(f"s.{name} by an index that is not known")
        if name == "last_control":
            return Num(f"s.{name}.data[e * s.{name}.shape[1] + {last}]", "S")
        read = {
            "joint_q": self.view_joint_position,
            "joint_qd": self.view_joint_velocity,
            "controls": lambda s, i: self.view_control(Step(s.back - 1), i),
            "force": lambda s, i: self.view_contact_force(Step(s.back - 1), i),
            "sensor": lambda s, i: self.view_sensor(Step(s.back - 1), i),
            "body_q": lambda s, i: self.earlier(PoseSymbol(None, None, i), s),
            "body_qd": self._twist,
            "scalar": lambda s, i: self.view_task_scalar(Step(), i),
            "pose": lambda s, i: self._task_pose(i),
        }
        if name in read:
            return read[name](step, last)
        layout = self.layout
        if name in ("frame_body", "body_robot", "body_mass"):
            return np.asarray(getattr(layout, name))[last].item()
        if name == "frame_pose":
            return constant(wp.transform(*layout.frame_pose[last].tolist()), "")
        if name == "body_com":
            return Vec(tuple(map(float, layout.body_com[last])))
        raise Refused(f"s.{name}")

    def _twist(self, s: Step, body: int) -> Vec:
        linear, angular = self.state.point_velocity(body, np.asarray(self.layout.body_com[body], dtype=float))
        return self.earlier(self.vector((*linear, *angular)), s)

    def _task_pose(self, index: int) -> PoseSymbol:
        given = self.state.task_pose(index)
        return PoseSymbol(self.rotation(given.rotation), self.vector(given.position))

    def shape(self, name: str) -> list:
        """Return the shape of an array of the view."""
        if name in ("step_end", "controls", "joint_q"):
            return [Num(f"s.{name}.shape[{axis}]", "i") for axis in range(3)]
        if not hasattr(self.layout, name):
            raise Refused(f"s.{name}.shape")
        return list(np.shape(getattr(self.layout, name)))
