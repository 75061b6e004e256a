# SPDX-License-Identifier: Apache-2.0
"""Points and frames on bodies that constraints, tendons and actuators look at."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..bake.lines import Lines, Matrix, Operand, Vector, known, text

if TYPE_CHECKING:
    from .base import Structure


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


def known_rotation(turn: np.ndarray) -> np.ndarray:
    """A rotation ``[3, 3]`` whose entries next to 0, 1 or -1 are that number."""
    return np.array([known(row) for row in np.asarray(turn)])


def scaled(lines: Lines, vector: Vector, factor: Operand) -> Vector:
    """A vector times a number."""
    return [lines.sum((x, factor)) for x in vector]
