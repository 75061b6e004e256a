# SPDX-License-Identifier: Apache-2.0
"""Source of what does not branch: what stands still, what moves (:mod:`.tree`), and forces (:mod:`.drive`)."""

from __future__ import annotations

import numpy as np

from ...bake.lines import Lines, Matrix, Vector, function, known, text
from .drive import Drive
from .marks import Marks
from .medium import Medium
from .model import BOX, CONVEX, CYLINDER, ELLIPSOID, FIELD, MESH, PhysicsModel, rotation
from .spin import write_spin
from .tendons import Tendons
from .tie_rows import TieRows
from .tree import IDENTITY, NOTHING, Tree


class Dynamics:
    """Writes ``place`` (once per rollout), ``stretch`` and ``drive`` (before a step), ``spin`` and ``move`` (after it).

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
        self.marks = Marks(model)
        self.tendons = Tendons(model, self.marks)
        self.drive = Drive(model, self.marks, self.tendons)

    def write(self) -> str:
        """Source of the functions."""
        forces = self.tendons.write(), self.drive.write(), write_spin(self.model, self.drive)  # these ask for marks
        self.medium = Medium(self.model, self.marks)
        self.bind = TieRows(self.model, self.marks, self.tendons).write()
        return "\n".join((*forces, self._place(), self._move()))

    def _place(self) -> str:
        """What stands still: geoms fixed to the world, and those of mocap bodies, whose poses are given."""
        lines, m = Lines("p"), self.mj
        frames: dict[int, tuple[Matrix, Vector]] = {0: (IDENTITY, NOTHING)}
        for body in range(1, m.nbody):
            if self.model.moves(body):
                continue
            if m.body_mocapid[body] >= 0:
                first = 7 * int(m.body_mocapid[body])
                position = [lines.let(f"w.mocap[{first + k}]") for k in range(3)]
                columns = self.columns(lines, [lines.let(f"w.mocap[{first + 3 + k}]") for k in range(4)])
            else:
                columns, position = frames[int(m.body_parentid[body])]
                position = lines.transform(columns, m.body_pos[body], position)
                columns = lines.times(columns, rotation(m.body_quat[body]))
            frames[body] = columns, position
            if body in self.recorded:
                self.keep(lines, body, position, columns, (NOTHING, NOTHING))
        for body, (columns, position) in frames.items():
            self.geoms(lines, body, position, columns)
            self.marks.write(lines, body, position, columns, None)
        for i, g in enumerate(self.model.standing):
            if g in self.used:
                first = f"GIVEN_POSE + {12 * i}"
                lines.add(f"for (int i = 0; i < 3; ++i) w.gpos[{g}][i] = splat(w.given[{first} + i]);")
                lines.add(f"for (int i = 0; i < 9; ++i) w.gmat[{g}][i] = splat(w.given[{first} + 3 + i]);")
        return function("place", lines)

    def _move(self) -> str:
        """Poses of bodies and geoms, axes, mass matrix and bias forces, from coordinates and velocities."""
        m, lines = self.mj, Lines("m")
        roots = [b for b in range(1, m.nbody) if self.model.moves(b) and not self.model.moves(int(m.body_parentid[b]))]
        for root in roots:
            Tree(self, lines, root).write()
        return "\n".join(("#if !COOPERATE  // a warp has its own, native/links.h", function("move", lines), "#endif"))

    def columns(self, lines: Lines, q: list[str]) -> Matrix:
        """Columns of the matrix of a unit quaternion (w, x, y, z)."""
        w, x, y, z = q

        def entry(expression: str) -> str:
            return lines.let(expression)

        return [
            [
                entry(f"1.0f - 2.0f * ({y} * {y} + {z} * {z})"),
                entry(f"2.0f * ({x} * {y} + {w} * {z})"),
                entry(f"2.0f * ({x} * {z} - {w} * {y})"),
            ],
            [
                entry(f"2.0f * ({x} * {y} - {w} * {z})"),
                entry(f"1.0f - 2.0f * ({x} * {x} + {z} * {z})"),
                entry(f"2.0f * ({y} * {z} + {w} * {x})"),
            ],
            [
                entry(f"2.0f * ({x} * {z} + {w} * {y})"),
                entry(f"2.0f * ({y} * {z} - {w} * {x})"),
                entry(f"1.0f - 2.0f * ({x} * {x} + {y} * {y})"),
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
