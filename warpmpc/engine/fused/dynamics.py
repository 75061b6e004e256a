# SPDX-License-Identifier: Apache-2.0
"""Source of what does not branch: what stands still, what moves (:mod:`.tree`), and forces (:mod:`.drive`)."""

from __future__ import annotations

import mujoco
import numpy as np

from ...bake.lines import Lines, Matrix, Vector, function, known, text
from .drive import Drive
from .marks import Marks
from .model import BOX, CONVEX, CYLINDER, ELLIPSOID, FREE, MESH, PhysicsModel, rotation
from .tendons import Tendons
from .tie_rows import TieRows
from .tree import IDENTITY, NOTHING, Tree


class Dynamics:
    """Writes ``place`` (once per rollout), ``stretch`` and ``drive`` (before every step), ``spin`` and ``move`` (after it).

    Args:
        model: The model.
        recorded: Bodies whose poses and velocities are kept for the record.
    """

    def __init__(self, model: PhysicsModel, recorded: frozenset[int]):
        self.model, self.mj, self.recorded = model, model.mj, recorded
        self.used = {g for pair in model.pairs for g in pair.geoms}
        """Geoms that may touch something."""
        kinds = ((pair, tuple(int(self.mj.geom_type[g]) for g in pair.geoms)) for pair in model.pairs)
        self.convex = {g for pair, kind in kinds if kind in CONVEX for g in pair.geoms}
        """Geoms that some other looks at as a convex shape, all of whose axes are needed."""
        self.marks = Marks(model)
        self.tendons = Tendons(model, self.marks)
        self.drive = Drive(model, self.marks, self.tendons)

    def write(self) -> str:
        """Source of the functions."""
        forces = self.tendons.write(), self.drive.write(), self._spin()  # these ask for marks
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
        return "\n".join(
            ("#if !COOPERATE  // a warp has its own, native/links.h", function("move", lines), "#endif")
        )

    def _spin(self) -> str:
        """Accelerations of bodies that float freely and alone, with their gyroscopic forces implicit.

        MuJoCo's ``implicitfast`` leaves the derivative of bias forces out for trees of several degrees of freedom,
        but not for these: (M + h ∂c/∂v) a = f, with the bias forces c_linear = m R (ω × (ω × r)) and
        c_angular = ω × I ω of a body with centre of mass r and inertia I about its origin. The accelerations that
        ``integrate`` has found for them are replaced.
        """
        m, lines = self.mj, Lines("g")
        if m.opt.integrator == int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST):
            for j in np.flatnonzero(m.jnt_type == FREE):
                first = int(m.jnt_dofadr[j])
                if self.model.dof_top.count(first) == 6:
                    self._spin_body(lines, int(m.jnt_bodyid[j]), first)
        return function("spin", lines)

    def _spin_body(self, lines: Lines, body: int, first: int) -> None:
        """One body that floats alone, whose degrees of freedom begin at ``first``."""
        columns = self.model.columns
        mass, moment, inertia = self.model.rigid(body)
        mass_of, r = columns.operand(mass), [columns.operand(moment[:, k]) for k in range(3)]
        local = [[columns.operand(inertia[:, i, j]) for j in range(3)] for i in range(3)]
        step, damping = float(self.mj.opt.timestep), float(self.mj.dof_damping[first])
        extra = float(self.mj.dof_armature[first]) + step * damping  # on the diagonal
        w3 = [f"w.v[{first + 3 + k}]" for k in range(3)]
        turn = [[f"w.cw[{first + 3 + k}][{i}]" for i in range(3)] for k in range(3)]  # columns
        heavy = lines.sum(mass_of, extra)
        over = lines.let(f"1.0f / {text(heavy)}")
        # forces in the body's frame; r is the centre times the mass
        push = [lines.dot(column, [f"w.fs[{first + i}]" for i in range(3)]) for column in turn]
        torque = [f"w.fs[{first + 3 + k}]" for k in range(3)]

        def skew(v: Vector) -> list[Vector]:
            """Rows of [v]×."""
            x, y, z = v
            return [[0.0, lines.sum((-1.0, z)), y], [z, 0.0, lines.sum((-1.0, x))], [lines.sum((-1.0, y)), x, 0.0]]

        def product(a: list[Vector], b: list[Vector]) -> list[Vector]:
            return [[lines.sum(*((a[i][k], b[k][j]) for k in range(3))) for j in range(3)] for i in range(3)]

        spin, arm = skew(w3), skew(r)
        turned = [lines.dot(row, w3) for row in local]
        carried = lines.cross(w3, r)
        both, swept, gyro, lever = product(spin, arm), skew(carried), product(spin, local), skew(turned)
        # linear rows: heavy a + B α = push, B = -[r]× - h ([ω × r]× + [ω]× [r]×), both in the body's frame
        b = [
            [lines.sum((-1.0, arm[i][j]), (-step, swept[i][j]), (-step, both[i][j])) for j in range(3)]
            for i in range(3)
        ]
        # angular rows: [r]× a + (I + h ([ω]× I - [I ω]×)) α = torque
        a = [
            [
                lines.sum(local[i][j], (step, gyro[i][j]), (-step, lever[i][j]), extra if i == j else 0.0)
                for j in range(3)
            ]
            for i in range(3)
        ]
        less = product(arm, b)
        schur = [[lines.sum(a[i][j], (lines.sum((-1.0, less[i][j])), over)) for j in range(3)] for i in range(3)]
        pushed = [lines.sum((-1.0, x)) for x in lines.cross(r, push)]
        right = [lines.sum(torque[i], (pushed[i], over)) for i in range(3)]
        # Cramer's rule by the columns of the matrix
        x, y, z = ([schur[i][j] for i in range(3)] for j in range(3))
        minors = lines.cross(y, z), lines.cross(z, x), lines.cross(x, y)
        scale = lines.let(f"1.0f / {text(lines.dot(x, minors[0]))}")
        angular = [lines.let(f"{text(lines.dot(minor, right))} * {scale}") for minor in minors]
        linear = [lines.let(f"({text(push[i])} - {text(lines.dot(b[i], angular))}) * {over}") for i in range(3)]
        for i in range(3):
            back = lines.sum(*((linear[k], turn[k][i]) for k in range(3)))
            lines.add(f"w.search[{first + i}] = {text(back)};")
            lines.add(f"w.search[{first + 3 + i}] = {angular[i]};")

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
