# SPDX-License-Identifier: Apache-2.0
"""Source of poses and velocities of frames on bodies, from what a rollout keeps of each body.

Points and frames on bodies that constraints, tendons and actuators look at.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import mujoco
import numpy as np

from .base import BALL, FREE, HINGE, IDENTITY, NOTHING, rotation
from .runtime.bake import Lines, Matrix, Operand, Vector, known, sincos, text

if TYPE_CHECKING:
    from .base import Structure
    from .model import PhysicsModel

Quaternion = Sequence[Operand]
"""A quaternion (w, x, y, z)."""
_OBJECTS = {
    mujoco.mjtObj.mjOBJ_BODY: ("body", "ipos", "iquat"),
    mujoco.mjtObj.mjOBJ_GEOM: ("geom", "pos", "quat"),
    mujoco.mjtObj.mjOBJ_SITE: ("site", "pos", "quat"),
    mujoco.mjtObj.mjOBJ_CAMERA: ("cam", "pos", "quat"),
}
"""Objects with a frame on a body, and the model's arrays that say where; that of a body is its inertia's."""
OBJECTS = frozenset({int(kind) for kind in _OBJECTS} | {int(mujoco.mjtObj.mjOBJ_XBODY)})
"""Types of objects that have a frame."""


def framed(m: mujoco.MjModel, kind: int, number: int) -> bool:
    """Return whether an object has a frame on a body: cameras that follow something have none."""
    camera = kind == int(mujoco.mjtObj.mjOBJ_CAMERA)
    return kind in OBJECTS and (not camera or m.cam_mode[number] == int(mujoco.mjtCamLight.mjCAMLIGHT_FIXED))


@dataclass(frozen=True)
class Frame:
    """A frame on a body."""

    body: int
    at: np.ndarray
    """Origin in the body's frame ``[3]`` [m]."""
    quat: np.ndarray
    """Rotation in the body's frame (w, x, y, z)."""

    @classmethod
    def of(cls, m: mujoco.MjModel, kind: int, number: int) -> Frame:
        """The frame of an object.

        Args:
            m: The model.
            kind: Type of the object, one of :data:`OBJECTS`.
            number: Its number.
        """
        if kind == int(mujoco.mjtObj.mjOBJ_XBODY):
            return cls(number, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
        name, at, quat = _OBJECTS[mujoco.mjtObj(kind)]
        body = number if name == "body" else int(getattr(m, f"{name}_bodyid")[number])
        return cls(body, getattr(m, f"{name}_{at}")[number], getattr(m, f"{name}_{quat}")[number])

    @cached_property
    def turn(self) -> np.ndarray:
        """Rotation in the body's frame ``[3, 3]``."""
        return rotation(self.quat)


class Frames:
    """Writes poses and velocities of frames, after the bodies of a world have been moved.

    Args:
        model: The model.
        lines: Takes the statements.
        rows: Row of each body that the rollout keeps.
    """

    def __init__(self, model: mujoco.MjModel, lines: Lines, rows: dict[int, int]):
        self.mj, self.lines, self._rows = model, lines, rows
        self._quats: dict[int, Quaternion] = {0: (1.0, 0.0, 0.0, 0.0)}

    def _kept(self, name: str, body: int) -> Vector:
        return [f"w.{name}[{self._rows[body]}][{k}]" for k in range(3)] if body else NOTHING

    def columns(self, frame: Frame) -> Matrix:
        """Columns of its rotation in the world."""
        if not frame.body:
            return [known(column) for column in frame.turn.T]
        row = self._rows[frame.body]
        own = [[f"w.bmat[{row}][{3 * k + axis}]" for k in range(3)] for axis in range(3)]
        return self.lines.times(own, frame.turn)

    def position(self, frame: Frame) -> Vector:
        """Its origin in the world [m]."""
        return [self.lines.sum(a, b) for a, b in zip(self._kept("bpos", frame.body), self._arm(frame), strict=True)]

    def spin(self, frame: Frame) -> Vector:
        """Angular velocity in the world's axes [rad/s]."""
        return self._kept("bang", frame.body)

    def speed(self, frame: Frame) -> Vector:
        """Velocity of its origin in the world's axes [m/s]."""
        carried = self.lines.cross(self.spin(frame), self._arm(frame))
        return [self.lines.sum(a, b) for a, b in zip(self._kept("blin", frame.body), carried, strict=True)]

    def _arm(self, frame: Frame) -> Vector:
        """From the body's origin to the frame's, in the world's axes."""
        whole = Frame(frame.body, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
        return self.lines.transform(self.columns(whole) if frame.body else IDENTITY, known(frame.at))

    def inside(self, columns: Matrix, vector: Vector) -> Vector:
        """A vector of the world in the axes of a frame."""
        return [self.lines.dot(column, vector) for column in columns]

    def quaternion(self, frame: Frame) -> Quaternion:
        """Rotation in the world, with the sign that MuJoCo's product along the tree has."""
        return self.product(self._body_quaternion(frame.body), known(frame.quat))

    def _body_quaternion(self, body: int) -> Quaternion:
        if body not in self._quats:
            self._quats[body] = self._turned(body)
        return self._quats[body]

    def _turned(self, body: int) -> Quaternion:
        m = self.mj
        if m.body_mocapid[body] >= 0:
            first = 7 * int(m.body_mocapid[body]) + 3
            return [f"w.mocap[{first + k}]" for k in range(4)]
        first, count = int(m.body_jntadr[body]), int(m.body_jntnum[body])
        if count and m.jnt_type[first] == FREE:
            return self._coordinates(int(m.jnt_qposadr[first]) + 3)
        out = self.product(self._body_quaternion(int(m.body_parentid[body])), known(m.body_quat[body]))
        for joint in range(first, first + count):
            at = int(m.jnt_qposadr[joint])
            if m.jnt_type[joint] == BALL:
                out = self.product(out, self._coordinates(at))
            elif m.jnt_type[joint] == HINGE:
                half = self.lines.let(f"0.5f * (w.q[{at}] - {float(m.qpos0[at])!r}f)")
                self.lines.add(sincos(half, f"{half}_sine", f"{half}_cosine"))
                axis = [self.lines.sum((float(x), f"{half}_sine")) for x in m.jnt_axis[joint]]
                out = self.product(out, [f"{half}_cosine", *axis])
        return out

    def _coordinates(self, at: int) -> Quaternion:
        return [f"w.q[{at + k}]" for k in range(4)]

    def product(self, a: Quaternion, b: Quaternion) -> Quaternion:
        """The rotation b, then a."""
        minus = [self.lines.sum((-1.0, x)) for x in a]
        return [
            self.lines.sum((a[0], b[0]), (minus[1], b[1]), (minus[2], b[2]), (minus[3], b[3])),
            self.lines.sum((a[0], b[1]), (a[1], b[0]), (a[2], b[3]), (minus[3], b[2])),
            self.lines.sum((a[0], b[2]), (minus[1], b[3]), (a[2], b[0]), (a[3], b[1])),
            self.lines.sum((a[0], b[3]), (a[1], b[2]), (minus[2], b[1]), (a[3], b[0])),
        ]

    def inverse(self, a: Quaternion) -> Quaternion:
        """The opposite rotation."""
        return [a[0], *(self.lines.sum((-1.0, x)) for x in a[1:])]


class Site(NamedTuple):
    """A frame on a body."""

    body: int
    at: tuple[float, ...]
    """Position in the body's frame [m]."""
    turn: tuple[float, ...]
    """Rotation in the body's frame, row by row."""


class Sites:
    """Collects sites while what needs them is written, then writes where they are.

    Args:
        model: The model.
    """

    def __init__(self, model: Structure):
        self.model = model
        self.all: list[Site] = []
        self.turned: set[int] = set()
        """Those whose rotation is asked for."""
        self.pushed: set[int] = set()
        """Those whose velocity and acceleration are asked for."""

    def index(self, body: int, at: np.ndarray, turn: np.ndarray | None = None) -> int:
        """Number of a site.

        Args:
            body: The body it is on.
            at: Position in the body's frame [m].
            turn: Rotation in the body's frame ``[3, 3]``, none if None.
        """
        rows = np.eye(3) if turn is None else turn
        site = Site(int(body), tuple(known(np.asarray(at))), tuple(np.ravel(known_rotation(rows)).tolist()))
        if site not in self.all:
            self.all.append(site)
        return self.all.index(site)

    def point(self, site: int) -> Vector:
        """Position in the world."""
        return [f"w.site_at[{site}][{k}]" for k in range(3)]

    def columns(self, site: int) -> Matrix:
        """Columns of the rotation in the world."""
        self.turned.add(site)
        return [[f"w.site_turn[{site}][{3 * k + axis}]" for k in range(3)] for axis in range(3)]

    def spin(self, site: int) -> Vector:
        """Angular velocity [rad/s]."""
        return self._motion("spin", site)

    def turning(self, site: int) -> Vector:
        """Angular acceleration while no joint accelerates [rad/s²]."""
        return self._motion("turning", site)

    def speed(self, site: int) -> Vector:
        """Velocity [m/s]."""
        return self._motion("speed", site)

    def falling(self, site: int) -> Vector:
        """Acceleration while no joint accelerates [m/s²]."""
        return self._motion("falling", site)

    def _motion(self, name: str, site: int) -> Vector:
        self.pushed.add(site)
        return [f"w.site_{name}[{site}][{k}]" if self.moves(site) else 0.0 for k in range(3)]

    def moves(self, site: int) -> bool:
        """Return whether joints move it."""
        return self.model.moves(self.all[site].body)

    def lever(self, lines: Lines, site: int, dof: int) -> Vector:
        """Velocity of a site for a degree of freedom [m/s per unit]."""
        top = self.model.dof_top[dof]
        slide = [f"w.cl[{dof}][{k}]" for k in range(3)]
        if self.model.slides(dof):
            return slide
        arm = lines.difference(self.point(site), [f"w.ref[{top}][{k}]" for k in range(3)])
        turned = lines.cross(self.axis(dof), arm)
        return [lines.sum(a, b) for a, b in zip(slide, turned, strict=True)]

    def axis(self, dof: int) -> Vector:
        """Axis that a degree of freedom turns about."""
        return [0.0] * 3 if self.model.slides(dof) else [f"w.cw[{dof}][{k}]" for k in range(3)]

    def write(
        self, lines: Lines, body: int, position: Vector, columns: Matrix, motion: tuple[Vector, ...] | None
    ) -> None:
        """Write where the sites of a body are.

        Args:
            lines: Takes the statements.
            body: The body.
            position: Its origin.
            columns: Of its rotation.
            motion: Angular velocity and acceleration, velocity and acceleration of its origin; None if it stands still.
        """
        for n, site in enumerate(self.all):
            if site.body != body:
                continue
            at = lines.transform(columns, site.at, position)
            for k in range(3):
                lines.add(f"w.site_at[{n}][{k}] = {text(at[k])};")
            if n in self.turned:
                turn = lines.times(columns, np.reshape(site.turn, (3, 3)))
                for k in range(3):
                    for axis in range(3):
                        lines.add(f"w.site_turn[{n}][{3 * k + axis}] = {text(turn[axis][k])};")
            if motion is not None and n in self.pushed:
                self._move(lines, n, lines.difference(at, position), *motion)

    def _move(
        self, lines: Lines, n: int, arm: Vector, spin: Vector, turning: Vector, speed: Vector, falling: Vector
    ) -> None:
        carried = lines.cross(spin, arm)
        swept, fast = lines.cross(spin, carried), [lines.sum(*parts) for parts in zip(speed, carried, strict=True)]
        rows = (("spin", spin), ("turning", turning), ("speed", fast))
        falls = [lines.sum(*parts) for parts in zip(falling, lines.cross(turning, arm), swept, strict=True)]
        for name, values in (*rows, ("falling", falls)):
            for k in range(3):
                lines.add(f"w.site_{name}[{n}][{k}] = {text(values[k])};")


class FrameTables:
    """Tables of a model that name frames on bodies by their numbers.

    Args:
        model: The model.
        sites: Takes the frames.
    """

    def __init__(self, model: PhysicsModel, sites: Sites):
        self.model, self.mj, self.sites = model, model.mj, sites

    def frame(self, body: int, at: np.ndarray, quat: np.ndarray) -> int:
        """Number of a frame whose rotation is asked for."""
        frame = self.sites.index(body, at, rotation(quat))
        self.sites.turned.add(frame)
        return frame


def known_rotation(turn: np.ndarray) -> np.ndarray:
    """A rotation ``[3, 3]`` whose entries next to 0, 1 or -1 are that number."""
    return np.array([known(row) for row in np.asarray(turn)])


def scaled(lines: Lines, vector: Vector, factor: Operand) -> Vector:
    """A vector times a number."""
    return [lines.sum((x, factor)) for x in vector]
