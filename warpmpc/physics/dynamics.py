# SPDX-License-Identifier: Apache-2.0
"""Source of what does not branch: what stands still, what moves (:mod:`.tree`), and forces (:mod:`.drive`).

Tables for the forces of a fluid on bodies as boxes of their inertia (MuJoCo, "Computation: Fluid forces").

Source of the accelerations of bodies that float freely and alone, with their gyroscopic forces implicit.

MuJoCo's ``implicitfast`` leaves the derivative of bias forces out for trees of several degrees of freedom, but not for
these: (M + h ∂c/∂v) a = f, with the bias forces c_linear = m R (ω × (ω × r)) and c_angular = ω × I ω of a body with
centre of mass r and inertia I about its origin. The accelerations that ``integrate`` has found for them are replaced.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from .base import FREE, IDENTITY, NOTHING, rotation
from .bodies import Bodies
from .constraint_rows import ConstraintRows
from .coriolis import write_skewed_solve
from .drive import ForceSource
from .runtime.bake import Lines, Matrix, Operand, Vector, function, text
from .sensing import Sensing
from .source_parts import floats, ints
from .tendons import Tendons
from .tree import TreeSource

if TYPE_CHECKING:
    from .base import Structure
    from .frames import Sites
    from .model import PhysicsModel


def write_gyroscopic(model: Structure, drive: ForceSource) -> str:
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

    def write(self, drive: ForceSource) -> None:
        """Write its acceleration; where forces resist several of its degrees of freedom at once, by elimination."""
        first, last = self.first, self.first + 5
        named = [(entry, f"w.spread[{n}]") for entry, n in drive.spreads.items()]
        named += [(entry, f"w.tendon_mass[{n}]") for entry, n in drive.tendons.masses.items()]
        more = [(i - first, j - first, name) for (i, j), name in named if first <= j and i <= last]
        if more or self.model.dampings[first, 1:].any() or self._uneven(drive):
            self._eliminate(more)
        else:
            self._alone(drive)

    def _skew(self, v: Vector) -> list[Vector]:
        """Rows of [v]×."""
        (x, y, z), lines = v, self.lines
        return [[0.0, lines.sum((-1.0, z)), y], [z, 0.0, lines.sum((-1.0, x))], [lines.sum((-1.0, y)), x, 0.0]]

    def _product(self, a: list[Vector], b: list[Vector]) -> list[Vector]:
        return [[self.lines.sum(*((a[i][k], b[k][j]) for k in range(3))) for j in range(3)] for i in range(3)]

    def _uneven(self, drive: ForceSource) -> bool:
        """Return whether one direction has another armature or damping than others."""
        model, dofs = self.model, range(self.first, self.first + 3)
        own = model.armatures[dofs], model.dampings[dofs, 0], model.array("dof_damping")[:, dofs]
        return any(np.ptp(x, axis=-1).any() for x in own) or any(drive.damps(i, actuators=True) for i in dofs)

    def _extra(self, drive: ForceSource, dof: int) -> Operand:
        """What a degree of freedom has on the diagonal besides: its armature, and its damping over a step."""
        return self.lines.sum(float(self.model.armatures[dof]), f"w.damp[{dof}]" if drive.damps(dof) else 0.0)

    def _blocks(self, extra: Vector) -> tuple[list[Vector], list[Vector], list[Vector]]:
        """[r]×, and what angular accelerations add to linear and angular rows, all in the body's frame.

        Args:
            extra: On the diagonal of the latter ``[3]``.
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
                lines.sum(local[i][j], (step, gyro[i][j]), (-step, lever[i][j]), extra[i] if i == j else 0.0)
                for j in range(3)
            ]
            for i in range(3)
        ]
        return arm, linear, angular

    def _alone(self, drive: ForceSource) -> None:
        lines, first = self.lines, self.first
        heavy = lines.sum(self._mass, self._extra(drive, first))
        over = lines.let(f"1.0f / {text(heavy)}")
        # forces in the body's frame; r is the centre times the mass
        push = [lines.dot(column, [f"w.fs[{first + i}]" for i in range(3)]) for column in self._turn]
        torque = [f"w.fs[{first + 3 + k}]" for k in range(3)]
        arm, b, a = self._blocks([self._extra(drive, first + 3 + k) for k in range(3)])
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
        arm, b, a = self._blocks(NOTHING)
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


class Fluid:
    """Sizes and tables of the bodies that a fluid resists.

    Args:
        model: The model.
        sites: Takes the frames of their inertias.
    """

    def __init__(self, model: PhysicsModel, sites: Sites):
        self.model, m = model, model.mj
        self.bodies = [b for b in range(1, m.nbody) if model.fluid and model.moves(b) and m.body_mass[b] > 0.0]
        self._sites = [sites.index(b, m.body_ipos[b], rotation(m.body_iquat[b])) for b in self.bodies]
        sites.turned.update(self._sites)
        sites.pushed.update(self._sites)

    @property
    def sizes(self) -> dict[str, int]:
        """Macros of the source."""
        return {"FLUID": len(self.bodies), "FLUID_IMPLICIT": int(self.model.implicit)}

    def tables(self) -> list[str]:
        """Definitions of the tables."""
        if not self.bodies:
            return []
        m, model = self.model.mj, self.model
        boxes = [self._box(b) for b in self.bodies]
        immersed = [[n for n, b in enumerate(self.bodies) if dof in model.body_dofs[b]] for dof in range(m.nv)]
        return [
            floats("wind", m.opt.wind),
            floats("fluid", [m.opt.density, m.opt.viscosity]),
            ints("fluid_site", self._sites),
            floats("fluid_box", [[model.columns.constant(box[:, k]) for k in range(3)] for box in boxes]),
            ints("fluid_box_at", [[model.columns.index(box[:, k]) for k in range(3)] for box in boxes]),
            ints("fluid_first", np.cumsum([0, *(len(row) for row in immersed)])),
            ints("fluid_body", [n for row in immersed for n in row]),
            ints("fluid_above_first", np.cumsum([0, *(len(row) for row in model.ancestors)])),
            ints("fluid_above", [j for row in model.ancestors for j in row]),
        ]

    def _box(self, body: int) -> np.ndarray:
        """Edges of a solid box of a body's mass and inertia, ``[W, 3]`` or ``[1, 3]`` [m]."""
        mass, inertia = self.model.array("body_mass")[:, body, None], self.model.array("body_inertia")[:, body]
        rest = inertia.sum(axis=1, keepdims=True) - 2.0 * inertia
        return np.sqrt(np.maximum(rest, 1e-15) * 6.0 / mass)


class Dynamics:
    """Writes ``place`` (once a rollout), ``stretch``, ``drive`` (before a step), ``gyroscopic`` and ``move`` (after).

    Args:
        model: The model.
        recorded: Bodies whose poses and velocities are kept for the record.
        sensors: How many sensors are read, the first ones.
    """

    def __init__(self, model: PhysicsModel, recorded: frozenset[int], *, sensors: int = 0):
        self.model, self.mj, self.recorded = model, model.mj, recorded
        self.bodies = Bodies(model, recorded)
        self.sites = self.bodies.sites
        self.tendons = Tendons(model, self.sites)
        self.sensing = Sensing(model, self.sites, self.tendons, count=sensors)
        self.drive = ForceSource(model, self.sites, self.tendons, kept=self.sensing.drives)

    def write(self) -> str:
        """Source of the functions."""
        # these ask for sites
        forces = self.tendons.write(), self.drive.write(), write_gyroscopic(self.model, self.drive)
        skewed = write_skewed_solve(self.model, self.drive.spreads)
        self.fluid = Fluid(self.model, self.sites)
        self.bind = ConstraintRows(self.model, self.sites, self.tendons).write()
        self.sense = self.sensing.write()
        return "\n".join((*forces, skewed, self._place(), self._move()))

    def _place(self) -> str:
        """Place what stands still: geoms fixed to the world, and those of mocap bodies, whose poses are given."""
        lines, m = Lines("p"), self.mj
        frames: dict[int, tuple[Matrix, Vector]] = {0: (IDENTITY, NOTHING)}
        for body in range(1, m.nbody):
            if self.model.moves(body):
                continue
            if m.body_mocapid[body] >= 0:
                first = 7 * int(m.body_mocapid[body])
                position = [lines.let(f"w.mocap[{first + k}]") for k in range(3)]
                columns = self.bodies.columns(lines, [lines.let(f"w.mocap[{first + 3 + k}]") for k in range(4)])
            else:
                columns, position = frames[int(m.body_parentid[body])]
                position = lines.transform(columns, m.body_pos[body], position)
                columns = lines.times(columns, rotation(m.body_quat[body]))
            frames[body] = columns, position
            if body in self.recorded:
                self.bodies.keep(lines, body, position, columns, (NOTHING, NOTHING))
        for body, (columns, position) in frames.items():
            self.bodies.geoms(lines, body, position, columns)
            self.sites.write(lines, body, position, columns, None)
        for i, g in enumerate(self.model.standing):
            if g in self.bodies.used:
                first = f"GIVEN_POSE + {12 * i}"
                lines.add(f"for (int i = 0; i < 3; ++i) w.gpos[{g}][i] = splat(w.given[{first} + i]);")
                lines.add(f"for (int i = 0; i < 9; ++i) w.gmat[{g}][i] = splat(w.given[{first} + 3 + i]);")
        return function("place", lines)

    def _move(self) -> str:
        """Poses of bodies and geoms, axes, mass matrix and bias forces, from coordinates and velocities."""
        m, lines = self.mj, Lines("m")
        roots = [b for b in range(1, m.nbody) if self.model.moves(b) and not self.model.moves(int(m.body_parentid[b]))]
        for root in roots:
            TreeSource(self.bodies, lines, root).write()
        return "\n".join(("#if !COOPERATE  // a warp has its own, native/links.h", function("move", lines), "#endif"))
