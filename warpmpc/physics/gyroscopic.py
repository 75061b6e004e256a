# SPDX-License-Identifier: Apache-2.0
"""Source of the accelerations of bodies that float freely and alone, with their gyroscopic forces implicit.

MuJoCo's ``implicitfast`` leaves the derivative of bias forces out for trees of several degrees of freedom, but not for
these: (M + h ∂c/∂v) a = f, with the bias forces c_linear = m R (ω × (ω × r)) and c_angular = ω × I ω of a body with
centre of mass r and inertia I about its origin. The accelerations that ``integrate`` has found for them are replaced.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from ..bake.lines import Lines, Operand, Vector, function, text
from .base import FREE

if TYPE_CHECKING:
    from .base import Structure
    from .drive import Drive


def write_gyroscopic(model: Structure, drive: Drive) -> str:
    """Source of ``gyroscopic``."""
    m, lines = model.mj, Lines("g")
    if m.opt.integrator == int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST):
        for j in np.flatnonzero(m.jnt_type == FREE):
            first = int(m.jnt_dofadr[j])
            if model.dof_top.count(first) == 6:
                Gyroscopic(model, lines, int(m.jnt_bodyid[j]), first).write(drive)
    return function("gyroscopic", lines)


class Gyroscopic:
    """Writes one body that floats alone.

    Args:
        model: The model.
        lines: Takes the statements.
        body: The body.
        first: First of its degrees of freedom.
    """

    def __init__(self, model: Structure, lines: Lines, body: int, first: int):
        self.model, self.lines, self.first = model, lines, first
        self._turn = [[f"w.cw[{first + 3 + k}][{i}]" for i in range(3)] for k in range(3)]  # columns
        columns, (mass, moment, inertia) = model.columns, model.rigid(body)
        self._mass, self._moment = columns.operand(mass), [columns.operand(moment[:, k]) for k in range(3)]
        self._inertia = [[columns.operand(inertia[:, i, j]) for j in range(3)] for i in range(3)]

    def write(self, drive: Drive) -> None:
        """Write its acceleration; where forces resist several of its degrees of freedom at once, by elimination."""
        first, last = self.first, self.first + 5
        named = [(entry, f"w.spread[{n}]") for entry, n in drive.spreads.items()]
        named += [(entry, f"w.tendon_mass[{n}]") for entry, n in drive.tendons.masses.items()]
        more = [(i - first, j - first, name) for (i, j), name in named if first <= j and i <= last]
        if more or self.model.dampings[first, 1:].any():
            self._eliminate(more)
        else:
            self._alone()

    def _skew(self, v: Vector) -> list[Vector]:
        """Rows of [v]×."""
        (x, y, z), lines = v, self.lines
        return [[0.0, lines.sum((-1.0, z)), y], [z, 0.0, lines.sum((-1.0, x))], [lines.sum((-1.0, y)), x, 0.0]]

    def _product(self, a: list[Vector], b: list[Vector]) -> list[Vector]:
        return [[self.lines.sum(*((a[i][k], b[k][j]) for k in range(3))) for j in range(3)] for i in range(3)]

    def _blocks(self, extra: float) -> tuple[list[Vector], list[Vector], list[Vector]]:
        """[r]×, and what angular accelerations add to linear and angular rows, all in the body's frame.

        Args:
            extra: On the diagonal of the latter.
        """
        lines, step = self.lines, float(self.model.mj.opt.timestep)
        w3, r, local = [f"w.v[{self.first + 3 + k}]" for k in range(3)], self._moment, self._inertia
        spin, arm = self._skew(w3), self._skew(r)
        turned = [lines.dot(row, w3) for row in local]
        carried = lines.cross(w3, r)
        both, swept = self._product(spin, arm), self._skew(carried)
        gyro, lever = self._product(spin, local), self._skew(turned)
        # linear rows: heavy a + B α = push, B = -[r]× - h ([ω × r]× + [ω]× [r]×)
        linear = [
            [lines.sum((-1.0, arm[i][j]), (-step, swept[i][j]), (-step, both[i][j])) for j in range(3)]
            for i in range(3)
        ]
        # angular rows: [r]× a + (I + h ([ω]× I - [I ω]×)) α = torque
        angular = [
            [
                lines.sum(local[i][j], (step, gyro[i][j]), (-step, lever[i][j]), extra if i == j else 0.0)
                for j in range(3)
            ]
            for i in range(3)
        ]
        return arm, linear, angular

    def _alone(self) -> None:
        m, lines, first = self.model.mj, self.lines, self.first
        damping = float(self.model.dampings[first, 0])
        extra = float(self.model.armatures[first]) + float(m.opt.timestep) * damping  # on the diagonal
        heavy = lines.sum(self._mass, extra)
        over = lines.let(f"1.0f / {text(heavy)}")
        # forces in the body's frame; r is the centre times the mass
        push = [lines.dot(column, [f"w.fs[{first + i}]" for i in range(3)]) for column in self._turn]
        torque = [f"w.fs[{first + 3 + k}]" for k in range(3)]
        arm, b, a = self._blocks(extra)
        less = self._product(arm, b)
        schur = [[lines.sum(a[i][j], (lines.sum((-1.0, less[i][j])), over)) for j in range(3)] for i in range(3)]
        pushed = [lines.sum((-1.0, x)) for x in lines.cross(self._moment, push)]
        right = [lines.sum(torque[i], (pushed[i], over)) for i in range(3)]
        # Cramer's rule by the columns of the matrix
        x, y, z = ([schur[i][j] for i in range(3)] for j in range(3))
        minors = lines.cross(y, z), lines.cross(z, x), lines.cross(x, y)
        scale = lines.let(f"1.0f / {text(lines.dot(x, minors[0]))}")
        angular = [lines.let(f"{text(lines.dot(minor, right))} * {scale}") for minor in minors]
        linear = [lines.let(f"({text(push[i])} - {text(lines.dot(b[i], angular))}) * {over}") for i in range(3)]
        for i in range(3):
            back = lines.sum(*((linear[k], self._turn[k][i]) for k in range(3)))
            lines.add(f"w.search[{first + i}] = {text(back)};")
            lines.add(f"w.search[{first + 3 + i}] = {angular[i]};")

    def _eliminate(self, more: list[tuple[int, int, str]]) -> None:
        lines, first, turn = self.lines, self.first, self._turn
        arm, b, a = self._blocks(0.0)
        matrix: list[list[Operand]] = [[0.0] * 6 for _ in range(6)]
        for i in range(3):
            for j in range(3):
                matrix[i][3 + j] = lines.sum(*((turn[k][i], b[k][j]) for k in range(3)))
                matrix[3 + i][j] = lines.sum(*((arm[i][k], turn[k][j]) for k in range(3)))
                matrix[3 + i][3 + j] = a[i][j]
            matrix[i][i] = self._mass
        for i in range(6):
            extra = float(self.model.armatures[first + i])
            matrix[i][i] = lines.sum(matrix[i][i], extra, f"w.damp[{first + i}]")
        for i, j, name in more:
            for row, column in {(i, j), (j, i)}:
                matrix[row][column] = lines.sum(matrix[row][column], name)
        right: list[Operand] = [f"w.fs[{first + i}]" for i in range(6)]
        for k in range(6):  # positive definite but for what is small with the step: no pivots
            over = lines.let(f"1.0f / {text(matrix[k][k])}")
            for i in range(k + 1, 6):
                factor = lines.sum((-1.0, lines.sum((matrix[i][k], over))))
                for j in range(k + 1, 6):
                    matrix[i][j] = lines.sum(matrix[i][j], (factor, matrix[k][j]))
                right[i] = lines.sum(right[i], (factor, right[k]))
            matrix[k][k] = over
        for k in reversed(range(6)):
            known = (lines.sum((-1.0, lines.sum((matrix[k][j], right[j])))) for j in range(k + 1, 6))
            right[k] = lines.sum((lines.sum(right[k], *known), matrix[k][k]))
        for k in range(6):
            lines.add(f"w.search[{first + k}] = {text(right[k])};")
