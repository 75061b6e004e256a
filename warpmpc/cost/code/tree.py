# SPDX-License-Identifier: Apache-2.0
"""Forward kinematics of a layout as straight-line source: where bodies are, about which axes they move, how fast."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from ...kernels.geometry.kinematics import BALL, DISTANCE, FREE
from ...physics.runtime.bake import Lines, Matrix, Operand, Vector, known, sincos

if TYPE_CHECKING:
    from ...scene.model.layout import Layout

_GIVEN = (int(FREE), int(DISTANCE), int(BALL))
"""Joints whose transform comes from outside as it is."""


@dataclass(frozen=True)
class Axis:
    """An axis of a joint: what its velocity does to everything beyond it."""

    dof: int
    """Joint velocity."""
    turns: bool
    """True for an angle."""
    direction: Vector
    """In the world's frame."""
    origin: Vector
    """A point on it [m]."""


@dataclass(frozen=True)
class Place:
    """Place of a body: a frame that moves, and the body's fixed pose in it."""

    columns: Matrix
    """Of the moving frame's rotation."""
    origin: Vector
    """Of the moving frame [m]."""
    rotation: np.ndarray
    """Of the body in the moving frame ``[3, 3]``."""
    offset: np.ndarray
    """Of the body in the moving frame ``[3]`` [m]."""
    axes: tuple[Axis, ...]
    """Axes between the world and the body, from the root on."""
    quaternion: list[Operand] | None = None
    """Of the moving frame (x, y, z, w), where it is asked for."""

    def moved(self, rotation: np.ndarray, offset: np.ndarray) -> Place:
        """The same moving frame, and a pose that is fixed to the body."""
        return replace(self, rotation=self.rotation @ rotation, offset=self.offset + self.rotation @ offset)


@dataclass(frozen=True)
class Given:
    """A transform that is an input of the source: of a free or ball joint, of a mocap body, of a pose of the task."""

    rotation: Matrix
    """By columns."""
    position: Vector
    quaternion: list[Operand]
    """(x, y, z, w)."""


class KinematicsSource:
    """Places of all bodies, written into a list of statements when they are first asked for.

    Args:
        layout: Joints and bodies.
        lines: Takes the statements.
        coordinate: Name of a joint coordinate, by its index.
        given: Transform of a joint that is no axis, by its index; free joints and mocap bodies.
        quaternions: Whether orientations are wanted as quaternions, too.
    """

    def __init__(
        self,
        layout: Layout,
        lines: Lines,
        coordinate: Callable[[int], str],
        given: Callable[[int], Given],
        *,
        quaternions: bool = False,
    ):
        self.layout, self.lines = layout, lines
        self._coordinate, self._given = coordinate, given
        self._joint = {int(child): j for j, child in enumerate(layout.joint_child)}
        self._mocap = set(layout.mocap_body.tolist())
        identity = known(np.zeros(3)), [0.0, 0.0, 0.0, 1.0]
        columns = [known(column) for column in np.eye(3)]
        self._world = Place(columns, identity[0], np.eye(3), np.zeros(3), (), identity[1] if quaternions else None)
        self._places: dict[int, Place] = {-1: self._world}
        self._angles: dict[int, tuple[str, str, str, str]] = {}

    def place(self, body: int) -> Place:
        """Place of a body; -1 is the world."""
        if body not in self._places:
            joint = self._joint[body]
            self._places[body] = self._across(joint, self.place(int(self.layout.joint_parent[joint])))
        return self._places[body]

    def columns(self, place: Place) -> Matrix:
        """Columns of a body's rotation."""
        return self.lines.times(place.columns, place.rotation)

    def position(self, place: Place) -> Vector:
        """Of a body's origin [m]."""
        return self.point(place, np.zeros(3))

    def point(self, place: Place, at: np.ndarray) -> Vector:
        """A point of a body, given in its own frame [m]."""
        return self.lines.transform(place.columns, known(place.offset + place.rotation @ at), place.origin)

    def quaternion(self, place: Place) -> list[Operand]:
        """Orientation of a body (x, y, z, w)."""
        return self._turned(place.quaternion, known(Rotation.from_matrix(place.rotation).as_quat()))

    def velocity(self, place: Place, point: Vector, speed: Callable[[int], Operand]) -> tuple[Vector, Vector]:
        """Velocity of a point that moves with a body, and the body's angular velocity.

        Args:
            place: The body.
            point: The point, in the world's frame.
            speed: Joint velocity by its index; 0.0 for those at rest.
        """
        linear, angular = [[], [], []], [[], [], []]
        for axis in place.axes:
            rate = speed(axis.dof)
            if rate == 0.0:
                continue
            column = self.lever(axis, point)
            for i in range(3):
                linear[i].append((rate, column[i]))
                if axis.turns:
                    angular[i].append((rate, axis.direction[i]))
        return [self.lines.sum(*terms) for terms in linear], [self.lines.sum(*terms) for terms in angular]

    def lever(self, axis: Axis, point: Vector) -> Vector:
        """Velocity of a point when an axis moves at unit speed: the linear part of a column of the Jacobian."""
        if not axis.turns:
            return axis.direction
        return self.lines.cross(axis.direction, self.lines.difference(point, axis.origin))

    def _across(self, joint: int, parent: Place) -> Place:
        layout, body = self.layout, int(self.layout.joint_child[joint])
        anchor = layout.joint_pose_parent[joint].astype(float)
        place = parent.moved(Rotation.from_quat(anchor[3:]).as_matrix(), anchor[:3])
        if body in self._mocap:
            place = self._placed(self._world, self._given(joint))
        elif int(layout.joint_type[joint]) in _GIVEN:
            place = self._placed(place, self._given(joint))
        else:
            linear, angular = layout.joint_dof_dim[joint]
            coordinate, dof = int(layout.joint_q_start[joint]), int(layout.joint_qd_start[joint])
            for k in range(linear + angular):
                move = self._slid if k < linear else self._turned_about
                place = move(place, layout.dof_axis[dof + k].astype(float), coordinate + k, dof + k)
        child = layout.joint_pose_child[joint].astype(float)
        back = Rotation.from_quat(child[3:]).inv()
        return place.moved(back.as_matrix(), -back.apply(child[:3]))

    def _slid(self, place: Place, axis: np.ndarray, coordinate: int, dof: int) -> Place:
        lines = self.lines
        direction = lines.transform(place.columns, known(place.rotation @ axis))
        start = self.position(place)
        q = self._coordinate(coordinate)
        origin = [lines.sum(o, (q, d)) for o, d in zip(start, direction, strict=True)]
        moved = Axis(dof, False, direction, origin)
        return replace(place, origin=origin, offset=np.zeros(3), axes=(*place.axes, moved))

    def _turned_about(self, place: Place, axis: np.ndarray, coordinate: int, dof: int) -> Place:
        """Turn about an axis, which becomes z of the moving frame."""
        lines, upright = self.lines, _to_z(axis)
        origin, before = self.position(place), lines.times(place.columns, place.rotation @ upright)
        s, c, half_s, half_c = self._angle(coordinate)
        columns = [
            [lines.sum((c, x), (s, y)) for x, y in zip(before[0], before[1], strict=True)],
            [self._minus(c, y, s, x) for x, y in zip(before[0], before[1], strict=True)],
            before[2],
        ]
        quaternion = None
        if place.quaternion is not None:
            fixed = Rotation.from_matrix(place.rotation @ upright).as_quat()
            quaternion = self._turned(self._turned(place.quaternion, known(fixed)), [0.0, 0.0, half_s, half_c])
        moved = Axis(dof, True, before[2], origin)
        return Place(columns, origin, upright.T, np.zeros(3), (*place.axes, moved), quaternion)

    def _minus(self, a: str, x: Operand, b: str, y: Operand) -> Operand:
        """A x - b y, a and b by name."""
        if isinstance(y, float):
            return self.lines.sum((a, x), (b, -y))
        if isinstance(x, float):
            return self.lines.sum((a, x), (-1.0, self.lines.let(f"{b} * {y}")))
        return self.lines.let(f"{a} * {x} - {b} * {y}")

    def _placed(self, place: Place, given: Given) -> Place:
        """A transform from outside on top of a place."""
        lines = self.lines
        frame = lines.times(place.columns, place.rotation)

        def inside(vector: Vector, origin: Vector) -> Vector:
            return [lines.sum(origin[i], *((v, c[i]) for v, c in zip(vector, frame, strict=True))) for i in range(3)]

        origin = inside(given.position, self.position(place))
        columns = [inside(column, [0.0, 0.0, 0.0]) for column in given.rotation]
        quaternion = None
        if place.quaternion is not None:
            fixed = known(Rotation.from_matrix(place.rotation).as_quat())
            quaternion = self._turned(self._turned(place.quaternion, fixed), given.quaternion)
        return Place(columns, origin, np.eye(3), np.zeros(3), place.axes, quaternion)

    def _angle(self, coordinate: int) -> tuple[str, str, str, str]:
        """Names of sine and cosine of a joint angle and of its half."""
        if coordinate not in self._angles:
            names = tuple(f"{kind}{coordinate}" for kind in ("sin", "cos", "half_sin", "half_cos"))
            self.lines.add(sincos(self._coordinate(coordinate), *names[:2], half=names[2:]))
            self._angles[coordinate] = names
        return self._angles[coordinate]

    def _turned(self, a: list[Operand], b: list[Operand]) -> list[Operand]:
        """Product of two quaternions (x, y, z, w)."""
        if b == [0.0, 0.0, 0.0, 1.0]:
            return a
        if a == [0.0, 0.0, 0.0, 1.0]:
            return b
        (ax, ay, az, aw), (bx, by, bz, bw) = a, b
        rows = (
            ((aw, bx), (ax, bw), (ay, bz), (az, by)),
            ((aw, by), (ay, bw), (az, bx), (ax, bz)),
            ((aw, bz), (az, bw), (ax, by), (ay, bx)),
        )
        out = [self._fourth(row) for row in rows]
        return [*out, self._fourth(((aw, bw),), ((ax, bx), (ay, by), (az, bz)))]

    def _fourth(self, plus: tuple, minus: tuple = ()) -> Operand:
        """Σ of products but the last of four, which is taken off; or of two groups."""
        if not minus:
            plus, minus = plus[:-1], plus[-1:]
        taken = self.lines.sum(*minus)
        return self.lines.sum(*plus, (-1.0, taken))


def _to_z(axis: np.ndarray) -> np.ndarray:
    """A rotation ``[3, 3]`` that turns z to an axis, with entries 0 and ±1 where it can."""
    axis = np.array(known(axis / np.linalg.norm(axis)))
    if np.count_nonzero(axis) == 1:
        k = int(np.flatnonzero(axis)[0])
        rotation = np.zeros((3, 3))
        rotation[k, 2] = axis[k]
        rotation[(k + 1) % 3, 0], rotation[(k + 2) % 3, 1] = 1.0, axis[k]
        return rotation
    helper = np.eye(3)[np.argmin(np.abs(axis))]
    x = np.cross(helper, axis)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], axis=1)
