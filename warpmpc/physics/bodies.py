# SPDX-License-Identifier: Apache-2.0
"""Source of geoms and records of a body whose pose is known."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .base import BOX, CYLINDER, ELLIPSOID, MESH, rotation
from .frames import Sites
from .model import CONVEX, FIELD
from .runtime.bake import Lines, Matrix, Vector, known, text

if TYPE_CHECKING:
    from .model import PhysicsModel


class Bodies:
    """Writes centres and axes of geoms, and what is kept of bodies for the record.

    Args:
        model: The model.
        recorded: Bodies whose poses and velocities are kept for the record.
    """

    def __init__(self, model: PhysicsModel, recorded: frozenset[int]):
        self.model, self.mj, self.recorded = model, model.mj, recorded
        self.used = {g for pair in model.pairs for g in pair.geoms}
        """Geoms that may touch something."""
        kinds = ((pair, tuple(int(self.mj.geom_type[g]) for g in pair.geoms)) for pair in model.pairs)
        self.convex = {g for pair, kind in kinds if kind in CONVEX | FIELD for g in pair.geoms}
        """Geoms that some other looks at as a convex shape, all of whose axes are needed."""
        self.sites = Sites(model)

    def columns(self, lines: Lines, q: list[str]) -> Matrix:
        """Columns of the matrix of a unit quaternion (w, x, y, z)."""
        w, x, y, z = q
        return [
            [
                lines.let(f"1.0f - 2.0f * ({y} * {y} + {z} * {z})"),
                lines.let(f"2.0f * ({x} * {y} + {w} * {z})"),
                lines.let(f"2.0f * ({x} * {z} - {w} * {y})"),
            ],
            [
                lines.let(f"2.0f * ({x} * {y} - {w} * {z})"),
                lines.let(f"1.0f - 2.0f * ({x} * {x} + {z} * {z})"),
                lines.let(f"2.0f * ({y} * {z} + {w} * {x})"),
            ],
            [
                lines.let(f"2.0f * ({x} * {z} + {w} * {y})"),
                lines.let(f"2.0f * ({y} * {z} - {w} * {x})"),
                lines.let(f"1.0f - 2.0f * ({x} * {x} + {y} * {y})"),
            ],
        ]

    def geoms(self, lines: Lines, body: int, position: Vector, columns: Matrix) -> None:
        """Centres and axes of a body's geoms."""
        m = self.mj
        for g in np.flatnonzero(m.geom_bodyid == body):
            if int(g) not in self.used or int(g) in self.model.standing:
                continue
            at = lines.transform(columns, known(m.geom_pos[g]), position)
            axes = lines.times(columns, rotation(m.geom_quat[g]))
            for k in range(3):
                lines.add(f"w.gpos[{g}][{k}] = {text(at[k])};")
                for axis in range(3):
                    if axis == 2 or g in self.convex or m.geom_type[g] in (BOX, CYLINDER, ELLIPSOID, MESH):
                        lines.add(f"w.gmat[{g}][{3 * k + axis}] = {text(axes[axis][k])};")

    def keep(self, lines: Lines, body: int, position: Vector, columns: Matrix, velocity: tuple[Vector, Vector]) -> None:
        """Keep a body's pose, its angular velocity, and the linear one at its origin."""
        row = sorted(self.recorded).index(body)
        for k in range(3):
            lines.add(f"w.bpos[{row}][{k}] = {text(position[k])};")
            lines.add(f"w.bang[{row}][{k}] = {text(velocity[0][k])};")
            lines.add(f"w.blin[{row}][{k}] = {text(velocity[1][k])};")
            for axis in range(3):
                lines.add(f"w.bmat[{row}][{3 * k + axis}] = {text(columns[axis][k])};")
