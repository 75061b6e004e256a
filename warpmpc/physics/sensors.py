# SPDX-License-Identifier: Apache-2.0
"""Source of a model's sensors of positions and velocities (MuJoCo, "Computation: Sensors")."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from ..bake.lines import Operand, Vector, literal, text
from .frames import OBJECTS, Frame, Frames

if TYPE_CHECKING:
    from .base import Structure

SENSOR = mujoco.mjtSensor
_REAL = int(mujoco.mjtDataType.mjDATATYPE_REAL)
_POSITIVE = int(mujoco.mjtDataType.mjDATATYPE_POSITIVE)


def unread_sensors(model: mujoco.MjModel) -> list[str]:
    """Kinds of a model's sensors that rollouts cannot read, sorted; empty if they read all."""
    out = set()
    for n in range(model.nsensor):
        kind = SENSOR(int(model.sensor_type[n]))
        if (kind not in _READERS and kind != SENSOR.mjSENS_CLOCK) or not _framed(model, n, kind):
            out.add(kind.name.removeprefix("mjSENS_").lower())
    return sorted(out)


def _framed(m: mujoco.MjModel, n: int, kind: mujoco.mjtSensor) -> bool:
    """Return whether the objects of a sensor have frames on bodies."""
    if kind not in _FRAMES:
        return True
    objects = [(int(m.sensor_objtype[n]), int(m.sensor_objid[n]))]
    if m.sensor_refid[n] >= 0:
        objects.append((int(m.sensor_reftype[n]), int(m.sensor_refid[n])))
    fixed = int(mujoco.mjtCamLight.mjCAMLIGHT_FIXED)
    camera = int(mujoco.mjtObj.mjOBJ_CAMERA)
    return all(kind in OBJECTS and (kind != camera or m.cam_mode[number] == fixed) for kind, number in objects)


class Sensors:
    """Writes what the sensors of a model read in the state that a world is in.

    Args:
        model: The model.
    """

    def __init__(self, model: Structure):
        self.model, self.mj = model, model.mj
        self.off = model.off("SENSOR")

    @property
    def bodies(self) -> frozenset[int]:
        """Bodies whose poses and velocities it needs."""
        m, out = self.mj, set()
        for n in range(0 if self.off else m.nsensor):
            kind = SENSOR(int(m.sensor_type[n]))
            if kind in _FRAMES:
                out |= {frame.body for frame in self._frames(n) if frame is not None}
            elif kind in (SENSOR.mjSENS_SUBTREECOM, SENSOR.mjSENS_SUBTREELINVEL):
                out |= set(self._subtree(n))
        return frozenset(out - {0})

    def write(self, frames: Frames) -> list[str | None]:
        """Expressions of all numbers, in the order of ``sensordata``; None for the time, which a float cannot hold.

        Args:
            frames: Writes where bodies are.
        """
        m = self.mj
        if self.off:
            return ["(T)0.0f"] * m.nsensordata
        out: list[str | None] = []
        for n in range(m.nsensor):
            if m.sensor_type[n] == int(SENSOR.mjSENS_CLOCK):
                out.append(None)
                continue
            values = _READERS[SENSOR(int(m.sensor_type[n]))](self, n, frames)
            out += [self._cut(n, f"(T)({text(value)})") for value in values]
        return out

    def _cut(self, n: int, value: str) -> str:
        """A number within a sensor's cutoff."""
        cutoff, kind = float(self.mj.sensor_cutoff[n]), int(self.mj.sensor_datatype[n])
        if cutoff <= 0.0 or kind not in (_REAL, _POSITIVE):
            return value
        upper = f"VMIN({value}, {literal(cutoff)})"
        return upper if kind == _POSITIVE else f"VMAX({upper}, {literal(-cutoff)})"

    def _frames(self, n: int) -> tuple[Frame, Frame | None]:
        """The frame of a sensor's object, and that it is seen from."""
        m = self.mj
        seen_from = int(m.sensor_refid[n])
        own = Frame.of(m, int(m.sensor_objtype[n]), int(m.sensor_objid[n]))
        return own, Frame.of(m, int(m.sensor_reftype[n]), seen_from) if seen_from >= 0 else None

    def _joint(self, n: int) -> int:
        return int(self.mj.sensor_objid[n])

    def joint_position(self, n: int, frames: Frames) -> Sequence[Operand]:
        """Coordinate of a slide or hinge, quaternion of a ball."""
        m, joint = self.mj, self._joint(n)
        return [f"w.q[{int(m.jnt_qposadr[joint]) + k}]" for k in range(int(m.sensor_dim[n]))]

    def joint_velocity(self, n: int, frames: Frames) -> Sequence[Operand]:
        """Velocity of a slide or hinge, angular one of a ball."""
        m, joint = self.mj, self._joint(n)
        return [f"w.v[{int(m.jnt_dofadr[joint]) + k}]" for k in range(int(m.sensor_dim[n]))]

    def position(self, n: int, frames: Frames) -> Vector:
        """Position of a frame."""
        own, seen_from = self._frames(n)
        at = frames.position(own)
        if seen_from is None:
            return at
        return frames.inside(frames.columns(seen_from), frames.lines.difference(at, frames.position(seen_from)))

    def rotation(self, n: int, frames: Frames) -> Sequence[Operand]:
        """Quaternion of a frame."""
        own, seen_from = self._frames(n)
        quat = frames.quaternion(own)
        return quat if seen_from is None else frames.product(frames.inverse(frames.quaternion(seen_from)), quat)

    def axis(self, n: int, frames: Frames) -> Vector:
        """An axis of a frame."""
        own, seen_from = self._frames(n)
        axis = frames.columns(own)[int(self.mj.sensor_type[n]) - int(SENSOR.mjSENS_FRAMEXAXIS)]
        return axis if seen_from is None else frames.inside(frames.columns(seen_from), axis)

    def speed(self, n: int, frames: Frames) -> Vector:
        """Velocity of a frame's origin."""
        own, seen_from = self._frames(n)
        speed, lines = frames.speed(own), frames.lines
        if seen_from is None:
            return speed
        away = lines.difference(frames.position(own), frames.position(seen_from))
        swept = lines.cross(frames.spin(seen_from), away)
        relative = lines.difference(lines.difference(speed, frames.speed(seen_from)), swept)
        return frames.inside(frames.columns(seen_from), relative)

    def spin(self, n: int, frames: Frames) -> Vector:
        """Angular velocity of a frame."""
        own, seen_from = self._frames(n)
        if seen_from is None:
            return frames.spin(own)
        relative = frames.lines.difference(frames.spin(own), frames.spin(seen_from))
        return frames.inside(frames.columns(seen_from), relative)

    def own_speed(self, n: int, frames: Frames) -> Vector:
        """Velocity of a site in its own axes."""
        own, _ = self._frames(n)
        return frames.inside(frames.columns(own), frames.speed(own))

    def own_spin(self, n: int, frames: Frames) -> Vector:
        """Angular velocity of a site in its own axes."""
        own, _ = self._frames(n)
        return frames.inside(frames.columns(own), frames.spin(own))

    def _subtree(self, n: int) -> list[int]:
        """Bodies below a sensor's body, that one first."""
        root, m = int(self.mj.sensor_objid[n]), self.mj
        out = [root]
        for body in range(root + 1, m.nbody):
            if int(m.body_parentid[body]) in out:
                out.append(body)
        return out

    def _mean(self, n: int, frames: Frames, of: Callable[[Frame], Vector]) -> Vector:
        """Mean over a subtree, by mass."""
        mass, lines, columns = self.model.array("body_mass"), frames.lines, self.model.columns
        bodies = self._subtree(n)
        whole = sum(mass[:, body] for body in bodies)
        at = [of(Frame.of(self.mj, int(mujoco.mjtObj.mjOBJ_BODY), body)) for body in bodies]
        shares = [columns.operand(mass[:, body] / np.maximum(whole, mujoco.mjMINVAL)) for body in bodies]
        return [lines.sum(*((share, place[k]) for share, place in zip(shares, at, strict=True))) for k in range(3)]

    def centre(self, n: int, frames: Frames) -> Vector:
        """Centre of mass of a subtree."""
        return self._mean(n, frames, frames.position)

    def centre_speed(self, n: int, frames: Frames) -> Vector:
        """Velocity of the centre of mass of a subtree."""
        return self._mean(n, frames, frames.speed)


_FRAMES = frozenset(
    getattr(SENSOR, f"mjSENS_{name}")
    for name in ("FRAMEPOS", "FRAMEQUAT", "FRAMEXAXIS", "FRAMEYAXIS", "FRAMEZAXIS", "FRAMELINVEL", "FRAMEANGVEL",
                 "VELOCIMETER", "GYRO")
)  # fmt: skip
"""Sensors of frames."""
_READERS: dict[mujoco.mjtSensor, Callable[[Sensors, int, Frames], Sequence[Operand]]] = {
    SENSOR.mjSENS_JOINTPOS: Sensors.joint_position,
    SENSOR.mjSENS_JOINTVEL: Sensors.joint_velocity,
    SENSOR.mjSENS_BALLQUAT: Sensors.joint_position,
    SENSOR.mjSENS_BALLANGVEL: Sensors.joint_velocity,
    SENSOR.mjSENS_FRAMEPOS: Sensors.position,
    SENSOR.mjSENS_FRAMEQUAT: Sensors.rotation,
    SENSOR.mjSENS_FRAMEXAXIS: Sensors.axis,
    SENSOR.mjSENS_FRAMEYAXIS: Sensors.axis,
    SENSOR.mjSENS_FRAMEZAXIS: Sensors.axis,
    SENSOR.mjSENS_FRAMELINVEL: Sensors.speed,
    SENSOR.mjSENS_FRAMEANGVEL: Sensors.spin,
    SENSOR.mjSENS_VELOCIMETER: Sensors.own_speed,
    SENSOR.mjSENS_GYRO: Sensors.own_spin,
    SENSOR.mjSENS_SUBTREECOM: Sensors.centre,
    SENSOR.mjSENS_SUBTREELINVEL: Sensors.centre_speed,
}
"""Sensors that rollouts read."""
