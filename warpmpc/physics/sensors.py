# SPDX-License-Identifier: Apache-2.0
"""Source of a model's sensors (MuJoCo, "Computation: Sensors"): here of what a state alone tells.

Source of what sensors show at the last physics step of a control, for cost terms and the record.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from .base import WRAP_JOINT, WRAP_PULLEY, WRAP_SITE, Structure, wraps
from .frames import Frame, Frames, framed
from .runtime.bake import Lines, Operand, Vector, literal, text
from .sensing import within_step
from .sensor_tables import unseen, untold
from .source_parts import ints

if TYPE_CHECKING:
    from .model import PhysicsModel

SENSOR = mujoco.mjtSensor
_REAL = int(mujoco.mjtDataType.mjDATATYPE_REAL)
_POSITIVE = int(mujoco.mjtDataType.mjDATATYPE_POSITIVE)


def unread_sensors(model: mujoco.MjModel, count: int | None = None) -> list[str]:
    """Kinds of a model's sensors, of the first ``count`` or of all, that rollouts cannot read, sorted."""
    numbers = range(model.nsensor if count is None else count)
    return sorted({found for n in numbers if (found := _unread(model, n))})


def _unread(m: mujoco.MjModel, n: int) -> str:
    """The kind of a sensor that is not read, with what it lacks; empty if it is read."""
    kind = SENSOR(int(m.sensor_type[n]))
    name = kind.name.removeprefix("mjSENS_").lower()
    if kind != SENSOR.mjSENS_CLOCK and kind not in _READERS and n not in within_step(m):
        return name
    objects = [(int(m.sensor_objtype[n]), int(m.sensor_objid[n])), (int(m.sensor_reftype[n]), int(m.sensor_refid[n]))]
    if kind in _FRAMED and not all(framed(m, *one) for one in objects if one[1] >= 0):
        return name
    if m.sensor_history[n, 0] or m.sensor_delay[n] or m.sensor_interval[n].any():
        return f"{name} (delay, interval)"
    if kind == SENSOR.mjSENS_TORQUE and not m.site_bodyid[m.sensor_objid[n]]:
        return f"{name} (on the world)"
    if kind in (SENSOR.mjSENS_FORCE, SENSOR.mjSENS_TORQUE) and _pulled(m, int(m.site_bodyid[m.sensor_objid[n]])):
        return f"{name} (beyond which a tendon goes on)"
    if kind == SENSOR.mjSENS_RANGEFINDER:
        return unseen(m, n)
    return untold(m, n) if kind == SENSOR.mjSENS_CONTACT else ""


def _pulled(m: mujoco.MjModel, root: int) -> bool:
    """Return whether a tendon along sites joins what is below a body with what is not."""
    below = set(Structure(m).subtree(root)) - {0}
    for tendon in range(m.ntendon):
        bodies = {
            int(of[m.wrap_objid[k]])
            for k in wraps(m, tendon)
            for of in ([] if m.wrap_type[k] in (WRAP_JOINT, WRAP_PULLEY) else
                       [m.site_bodyid if m.wrap_type[k] == WRAP_SITE else m.geom_bodyid])
        }  # fmt: skip
        if bodies & below and bodies - below:
            return True
    return False


class SensorSource:
    """Writes what the sensors of a model read in the state that a world is in.

    Args:
        model: The model.
        count: How many sensors are read, the first ones; all if None.
    """

    def __init__(self, model: Structure, count: int | None = None):
        self.model, self.mj = model, model.mj
        self.count = model.mj.nsensor if count is None else count
        self.off = model.off("SENSOR")
        self._steps = {} if self.off else self._firsts()

    def _firsts(self) -> dict[int, int]:
        """Place in ``w.sensed`` of the first number of every sensor that is read within a step."""
        within = within_step(self.mj, self.count)
        widths = [int(self.mj.sensor_dim[n]) for n in within]
        return dict(zip(within, np.cumsum([0, *widths])[:-1].tolist(), strict=True))

    @property
    def bodies(self) -> frozenset[int]:
        """Bodies whose poses and velocities it needs."""
        m, out = self.mj, set()
        for n in range(0 if self.off else self.count):
            kind = SENSOR(int(m.sensor_type[n]))
            if kind in _FRAMES:
                out |= {frame.body for frame in self._frames(n) if frame is not None}
            elif kind in _SUBTREES:
                out |= set(self.model.subtree(int(self.mj.sensor_objid[n])))
        return frozenset(out - {0})

    def write(self, frames: Frames) -> list[str | None]:
        """Expressions of all numbers, in the order of ``sensordata``; None for the time, which a float cannot hold.

        Args:
            frames: Writes where bodies are.
        """
        m = self.mj
        if self.off:
            return ["(T)0.0f"] * int(m.sensor_dim[: self.count].sum())
        out: list[str | None] = []
        for n in range(self.count):
            if m.sensor_type[n] == int(SENSOR.mjSENS_CLOCK):
                out.append(None)
                continue
            if n in self._steps:
                values = [f"w.sensed[{self._steps[n] + k}]" for k in range(int(m.sensor_dim[n]))]
            else:
                values = _READERS[SENSOR(int(m.sensor_type[n]))](self, n, frames)
            out += [self._cut(n, f"(T)({text(value)})") for value in values]
        return out

    def _cut(self, n: int, value: str) -> str:
        """A number within a sensor's cutoff."""
        cutoff, kind = float(self.mj.sensor_cutoff[n]), int(self.mj.sensor_datatype[n])
        if cutoff <= 0.0 or kind not in (_REAL, _POSITIVE) or self.mj.sensor_type[n] == int(SENSOR.mjSENS_CONTACT):
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

    def _mean(self, n: int, frames: Frames, of: Callable[[Frame], Vector]) -> Vector:
        """Mean over a subtree, by mass."""
        mass, lines, columns = self.model.array("body_mass"), frames.lines, self.model.columns
        bodies = self.model.subtree(int(self.mj.sensor_objid[n]))
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

    def momentum(self, n: int, frames: Frames) -> Vector:
        """Angular momentum of a subtree about its centre of mass."""
        m, lines, columns = self.mj, frames.lines, self.model.columns
        centre, speed = self.centre(n, frames), self.centre_speed(n, frames)
        parts: list[Vector] = []
        for body in self.model.subtree(int(m.sensor_objid[n])):
            if not m.body_mass[body]:
                continue
            frame = Frame.of(m, int(mujoco.mjtObj.mjOBJ_BODY), body)
            axes, inertia = frames.columns(frame), self.model.array("body_inertia")[:, body]
            spin = frames.inside(axes, frames.spin(frame))
            own = [lines.sum((columns.operand(inertia[:, k]), spin[k])) for k in range(3)]
            away = lines.difference(frames.position(frame), centre)
            push = lines.difference(frames.speed(frame), speed)
            mass = columns.operand(self.model.array("body_mass")[:, body])
            swept = [lines.sum((mass, x)) for x in lines.cross(away, push)]
            parts += [swept, [lines.sum(*((own[k], axes[k][i]) for k in range(3))) for i in range(3)]]
        return [lines.sum(*(part[k] for part in parts)) for k in range(3)]

    def field(self, n: int, frames: Frames) -> Vector:
        """The magnetic field in the axes of a site."""
        own, _ = self._frames(n)
        return frames.inside(frames.columns(own), [float(x) for x in self.mj.opt.magnetic])

    def pixel(self, n: int, frames: Frames) -> Sequence[Operand]:
        """Where a camera sees a site [px]."""
        m, lines, cam = self.mj, frames.lines, int(self.mj.sensor_refid[n])
        own, seen_from = self._frames(n)
        away = lines.difference(frames.position(own), frames.position(seen_from))
        x, y, z = (text(v) for v in frames.inside(frames.columns(seen_from), away))
        size, pixels = m.cam_sensorsize[cam], m.cam_resolution[cam].astype(float)
        focal = np.full(2, 0.5 / np.tan(np.radians(float(m.cam_fovy[cam])) / 2.0) * pixels[1])
        if size.all():
            focal = m.cam_intrinsic[cam, :2] / size * pixels
        over = lines.let(f"1.0f / VSELECT(VABS({z}) < 1e-15f, VSELECT({z} < 0.0f, (T)-1e-15f, (T)1e-15f), {z})")
        seen = lines.let(f"{x} * {over}"), lines.let(f"{y} * {over}")
        return [
            lines.sum((sign * float(focal[k]), seen[k]), 0.5 * float(pixels[k])) for k, sign in ((0, -1.0), (1, 1.0))
        ]


def _named(*names: str) -> frozenset[mujoco.mjtSensor]:
    return frozenset(getattr(SENSOR, f"mjSENS_{name}") for name in names)


_FRAMES = _named("FRAMEPOS", "FRAMEQUAT", "FRAMEXAXIS", "FRAMEYAXIS", "FRAMEZAXIS", "FRAMELINVEL", "FRAMEANGVEL",
                 "VELOCIMETER", "GYRO", "MAGNETOMETER", "CAMPROJECTION")  # fmt: skip
"""Sensors of frames in a state."""
_FRAMED = _FRAMES | _named("FRAMELINACC", "FRAMEANGACC", "INSIDESITE")
"""All sensors of frames."""
_SUBTREES = _named("SUBTREECOM", "SUBTREELINVEL", "SUBTREEANGMOM")
_READERS: dict[mujoco.mjtSensor, Callable[[SensorSource, int, Frames], Sequence[Operand]]] = {
    SENSOR.mjSENS_JOINTPOS: SensorSource.joint_position,
    SENSOR.mjSENS_JOINTVEL: SensorSource.joint_velocity,
    SENSOR.mjSENS_BALLQUAT: SensorSource.joint_position,
    SENSOR.mjSENS_BALLANGVEL: SensorSource.joint_velocity,
    SENSOR.mjSENS_FRAMEPOS: SensorSource.position,
    SENSOR.mjSENS_FRAMEQUAT: SensorSource.rotation,
    SENSOR.mjSENS_FRAMEXAXIS: SensorSource.axis,
    SENSOR.mjSENS_FRAMEYAXIS: SensorSource.axis,
    SENSOR.mjSENS_FRAMEZAXIS: SensorSource.axis,
    SENSOR.mjSENS_FRAMELINVEL: SensorSource.speed,
    SENSOR.mjSENS_FRAMEANGVEL: SensorSource.spin,
    SENSOR.mjSENS_VELOCIMETER: SensorSource.own_speed,
    SENSOR.mjSENS_GYRO: SensorSource.own_spin,
    SENSOR.mjSENS_SUBTREECOM: SensorSource.centre,
    SENSOR.mjSENS_SUBTREELINVEL: SensorSource.centre_speed,
    SENSOR.mjSENS_SUBTREEANGMOM: SensorSource.momentum,
    SENSOR.mjSENS_MAGNETOMETER: SensorSource.field,
    SENSOR.mjSENS_CAMPROJECTION: SensorSource.pixel,
}
"""Sensors that a state alone tells; those of :func:`~.sensing.within_step` are read besides."""


@dataclass(frozen=True)
class Readings:
    """Statements that leave readings in ``fresh``; ``native/rollout.h`` has them in ``shown`` after the control."""

    places: Sequence[int] = ()
    """Number of the sensors outside behind each of the readings."""
    before: str = ""
    """Before the last physics step: what a state alone tells."""
    after: str = ""
    """After it: what was read within the step."""

    @property
    def tables(self) -> list[str]:
        """Definitions of tables."""
        return [ints("shown_of", self.places)]


def sensed_bodies(model: PhysicsModel, sensors: int) -> frozenset[int]:
    """Bodies whose poses and velocities readings need.

    Args:
        model: The model.
        sensors: How many of its sensors are read, the first ones.
    """
    return SensorSource(model, sensors).bodies


def write_readings(model: PhysicsModel, sensors: int, kept: Sequence[int], places: Sequence[int]) -> Readings:
    """Write the statements.

    Args:
        model: The model.
        sensors: Number of sensors that are read, from the first; clocks are not among them.
        kept: Bodies whose poses and velocities the rollout keeps, in their order.
        places: Number of the sensors outside behind each of the readings.
    """
    lines = Lines("r")
    frames = Frames(model.mj, lines, {body: row for row, body in enumerate(kept)})
    puts = [f"fresh[{n}] = {text(value)};" for n, value in enumerate(SensorSource(model, sensors).write(frames))]

    def block(statements: Iterable[str]) -> str:
        return "\n".join(("{", *statements, "}"))

    within = [put for put in puts if "w.sensed[" in put]
    others = [put for put in puts if "w.sensed[" not in put]
    return Readings(places, block((*lines.statements, *others)), block(within))
