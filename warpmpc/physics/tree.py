# SPDX-License-Identifier: Apache-2.0
"""Source of one tree of bodies: where they are, their axes, mass matrix and bias forces.

Spatial vectors are taken about their own point for every tree (where its first moving body is), which keeps
single precision good far from the origin: composite rigid bodies and Newton-Euler as in Featherstone, "Rigid Body
Dynamics Algorithms" (2008), chapters 5 and 6.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .base import BALL, FREE, IDENTITY, NOTHING, SLIDE, packed, rotation
from .coriolis import Coriolis
from .runtime.bake import Lines, Matrix, Operand, Vector, known, sincos, text

if TYPE_CHECKING:
    from .bodies import Bodies

Inertia = list[Operand]
"""Of a body about the tree's point: xx, yy, zz, xy, xz, yz, mass times centre (3), mass."""


class TreeSource:
    """Writes one tree, depth first, so that few values live long.

    Args:
        bodies: Writes geoms and records of its bodies.
        lines: Takes the statements.
        root: First body that joints move.
    """

    def __init__(self, bodies: Bodies, lines: Lines, root: int):
        self.bodies, self.lines, self.root = bodies, lines, root
        self.model, self.mj = bodies.model, bodies.mj
        self.reference: Vector | None = None
        """The point that spatial vectors are taken about."""
        self.turns: dict[int, Vector] = {}
        """Angular part of every axis."""
        self.slides: dict[int, Vector] = {}
        """Linear part of every axis, at the reference."""
        self.coriolis = Coriolis(self.model, lines) if self.model.skewed else None
        """Derivatives of the bias forces by velocity, if they are asked for."""

    def write(self) -> None:
        """Write the tree."""
        parent = int(self.mj.body_parentid[self.root])
        columns, position = IDENTITY, NOTHING
        if parent:
            columns, position = self._fixed(parent)
        self.gravity = gravity = self.model.gravity
        self._visit(
            self.root, position, columns, (NOTHING, NOTHING, NOTHING, [self.lines.sum((-1.0, x)) for x in gravity])
        )

    def _fixed(self, body: int) -> tuple[Matrix, Vector]:
        """Pose of a body that nothing moves."""
        m, chain = self.mj, []
        while body:
            chain.append(body)
            body = int(m.body_parentid[body])
        turn, at = np.eye(3), np.zeros(3)
        for b in reversed(chain):
            at = at + turn @ m.body_pos[b]
            turn = turn @ rotation(m.body_quat[b])
        return [known(column) for column in turn.T], [float(x) for x in at]

    def _visit(
        self, b: int, position: Vector, columns: Matrix, motion: tuple
    ) -> tuple[Inertia, Vector, Vector, Vector]:
        """Inertia, torque and force of everything from a body on, and what their derivatives take."""
        m, lines = self.mj, self.lines
        if not m.body_jntnum[b] or m.jnt_type[m.body_jntadr[b]] != FREE:  # whose pose is all in its coordinates
            position = lines.transform(columns, known(m.body_pos[b]), position)
            columns = lines.times(columns, rotation(m.body_quat[b]))
        for j in range(m.body_jntadr[b], m.body_jntadr[b] + m.body_jntnum[b]):
            before, (position, columns, motion) = motion, self._joint(j, position, columns, motion)
            if self.coriolis:
                self._changing(j, before, motion)
        own = range(m.body_dofadr[b], m.body_dofadr[b] + m.body_dofnum[b]) if m.body_dofnum[b] else range(0)
        for i in own:
            for k in range(3):
                lines.add(f"w.cw[{i}][{k}] = {text(self.turns[i][k])};")
                lines.add(f"w.cl[{i}][{k}] = {text(self.slides[i][k])};")
        self.bodies.geoms(lines, b, position, columns)
        if self.reference is None:
            self._refer(position)
        angular, linear, turning, falling = motion
        if b in self.bodies.recorded:
            arm = lines.difference(position, self.reference)
            at_origin = self._sum(linear, lines.cross(angular, arm))
            self.bodies.keep(lines, b, position, columns, (angular, at_origin))
        self._site_of(b, position, columns, motion)
        inertia = self._inertia(b, position, columns)
        share = self.model.lift(b)
        felt = [self.lines.sum(x, (share, g)) for x, g in zip(falling, self.gravity, strict=True)] if share else falling
        moment, mass = inertia[6:9], inertia[9]
        spin = self._sum(self._times(inertia, angular), lines.cross(moment, linear))
        push = lines.difference(self._scaled(linear, mass), lines.cross(moment, angular))
        torque = self._sum(
            self._times(inertia, turning),
            lines.cross(moment, felt),
            lines.cross(angular, spin),
            lines.cross(linear, push),
        )
        force = self._sum(
            lines.difference(self._scaled(felt, mass), lines.cross(moment, turning)), lines.cross(angular, push)
        )
        swirl = self.coriolis.swirl(inertia, motion, self._times(inertia, angular), push) if self.coriolis else []
        for child in np.flatnonzero(m.body_parentid == b):
            if child <= b:
                continue
            more, torque_of, force_of, swirl_of = self._visit(int(child), position, columns, motion)
            inertia = [lines.sum(x, y) for x, y in zip(inertia, more, strict=True)]
            torque, force, swirl = self._sum(torque, torque_of), self._sum(force, force_of), self._sum(swirl, swirl_of)
        self._axes(own, inertia, torque, force, swirl)
        return inertia, torque, force, swirl

    def _site_of(self, b: int, position: Vector, columns: Matrix, motion: tuple) -> None:
        """Sites on a body; their acceleration is that of points of the body, without gravity."""
        lines, sites = self.lines, self.bodies.sites
        if not any(sites.all[n].body == b for n in sites.pushed):
            sites.write(lines, b, position, columns, None)
            return
        angular, linear, turning, falling = motion
        arm = lines.difference(position, self.reference)
        speed = self._sum(linear, lines.cross(angular, arm))
        freely = self._sum(falling, self.gravity)
        at_origin = self._sum(freely, lines.cross(turning, arm), lines.cross(angular, speed))
        sites.write(lines, b, position, columns, (angular, turning, speed, at_origin))

    def _axes(self, own: range, inertia: Inertia, torque: Vector, force: Vector, swirl: Vector) -> None:
        """Mass matrix and bias of a body's degrees of freedom."""
        lines, moment, armature = self.lines, inertia[6:9], self.model.tendon_armatures

        def weight(turn: Vector, slide: Vector) -> tuple[Vector, Vector]:
            torque = self._sum(self._times(inertia, turn), lines.cross(moment, slide))
            return torque, lines.difference(self._scaled(slide, inertia[9]), lines.cross(moment, turn))

        for i in own:
            turn, push = weight(self.turns[i], self.slides[i])
            for j in [i, *self.model.ancestors[i]]:
                products = [*zip(self.turns[j], turn, strict=True), *zip(self.slides[j], push, strict=True)]
                entry = lines.sum(
                    *products, armature.get((i, j), 0.0) + (float(self.model.armatures[i]) if i == j else 0.0)
                )
                lines.add(f"w.mm[{packed(i, j)}] = {text(entry)};")
            products = [*zip(self.turns[i], torque, strict=True), *zip(self.slides[i], force, strict=True)]
            lines.add(f"w.bias[{i}] = {text(lines.sum(*products))};")
            if self.coriolis:
                axes = self.turns, self.slides
                self.coriolis.write(i, (self.turns[i], self.slides[i]), (turn, push), weight, swirl, axes)

    def _joint(self, j: int, position: Vector, columns: Matrix, motion: tuple) -> tuple[Vector, Matrix, tuple]:
        """Pose and motion after a joint."""
        m, lines = self.mj, self.lines
        kind, a, i = int(m.jnt_type[j]), int(m.jnt_qposadr[j]), int(m.jnt_dofadr[j])
        angular, linear, turning, falling = motion
        if kind == FREE:
            position = [f"w.q[{a + k}]" for k in range(3)]
            columns = self._oriented(a + 3)
            self._refer(position)
            for k in range(3):
                self.turns[i + k], self.slides[i + k] = NOTHING, IDENTITY[k]
            linear = self._sum(linear, [f"w.v[{i + k}]" for k in range(3)])
            motion = angular, linear, turning, falling
            return position, columns, self._spun(i + 3, columns, None, motion)
        anchor = lines.transform(columns, known(m.jnt_pos[j]), position)
        if kind == BALL:
            self._refer(anchor)
            turned = self._oriented(a)
            columns = [self._within(columns, column) for column in turned]
            position = lines.difference(anchor, lines.transform(columns, known(m.jnt_pos[j])))
            return position, columns, self._spun(i, columns, anchor, motion)
        axis = lines.transform(columns, known(m.jnt_axis[j]))
        q = lines.let(f"w.q[{a}]")
        moved = lines.sum(q, -float(m.qpos0[a]))
        if kind == SLIDE:
            position = [lines.sum(p, (moved, d)) for p, d in zip(position, axis, strict=True)]
            self.turns[i], self.slides[i] = NOTHING, axis
        else:
            self._refer(anchor)
            columns = self._turned(columns, known(m.jnt_axis[j]), moved, i)
            position = lines.difference(anchor, lines.transform(columns, known(m.jnt_pos[j])))
            self.turns[i] = axis
            self.slides[i] = lines.cross(axis, lines.difference(self.reference, anchor))
        rate = f"w.v[{i}]"
        return (
            position,
            columns,
            self._moved(self._scaled(self.turns[i], rate), self._scaled(self.slides[i], rate), motion),
        )

    def _changing(self, j: int, before: tuple, after: tuple) -> None:
        """Changes of the axes of a joint, for the derivatives of bias forces."""
        first, kind = int(self.mj.jnt_dofadr[j]), int(self.mj.jnt_type[j])
        axes = self.turns, self.slides
        if kind == FREE:  # along the axes of the world, then about the body's own
            still = NOTHING, NOTHING
            self.coriolis.moved(range(first, first + 3), still, still, *axes)
            before, first = (NOTHING, after[1]), first + 3
        self.coriolis.moved(range(first, first + (3 if kind in (FREE, BALL) else 1)), before, after, *axes)

    def _refer(self, point: Vector) -> None:
        """Take spatial vectors about a point, unless one is chosen."""
        if self.reference is None:
            self.reference = point
            for k in range(3):
                self.lines.add(f"w.ref[{self.mj.body_dofadr[self.root]}][{k}] = {text(point[k])};")

    def _oriented(self, a: int) -> Matrix:
        """Columns of the normalized quaternion at a coordinate."""
        lines = self.lines
        q = [f"w.q[{a + k}]" for k in range(4)]
        scale = lines.let(f"1.0f / VSQRT({' + '.join(f'{x} * {x}' for x in q)})")
        return self.bodies.columns(lines, [lines.let(f"{x} * {scale}") for x in q])

    def _within(self, columns: Matrix, v: Vector) -> Vector:
        """M v, M by its columns."""
        return [self.lines.sum(*((x, column[i]) for x, column in zip(v, columns, strict=True))) for i in range(3)]

    def _spun(self, first: int, columns: Matrix, anchor: Vector | None, motion: tuple) -> tuple:
        """Motion after three degrees of freedom that turn about the columns of a body."""
        lines = self.lines
        spin = self._within(columns, [f"w.v[{first + k}]" for k in range(3)])
        arm = NOTHING if anchor is None else lines.difference(self.reference, anchor)
        for k in range(3):
            self.turns[first + k], self.slides[first + k] = columns[k], lines.cross(columns[k], arm)
        return self._moved(spin, lines.cross(spin, arm), motion)

    def _moved(self, turn: Vector, slide: Vector, motion: tuple) -> tuple:
        """Velocity and acceleration after a joint whose velocity is a twist."""
        angular, linear, turning, falling = motion
        lines = self.lines
        turning = self._sum(turning, lines.cross(angular, turn))
        falling = self._sum(falling, lines.cross(angular, slide), lines.cross(linear, turn))
        return self._sum(angular, turn), self._sum(linear, slide), turning, falling

    def _turned(self, columns: Matrix, axis: list[float], angle: Operand, i: int) -> Matrix:
        """Columns after a turn about an axis of the body (Rodrigues)."""
        lines = self.lines
        s, c = f"sin{i}", f"cos{i}"
        lines.add(sincos(text(angle), s, c))
        along = [k for k in range(3) if abs(abs(axis[k]) - 1.0) < 1e-9]
        if along:  # two columns turn
            k, sign = along[0], axis[along[0]]
            first, second = (k + 1) % 3, (k + 2) % 3
            sine = s if sign > 0.0 else lines.let(f"-{s}")
            less = lines.let(f"-{sine}")
            out = list(columns)
            x, y = columns[first], columns[second]
            out[first] = [lines.sum((c, x[u]), (sine, y[u])) for u in range(3)]
            out[second] = [lines.sum((c, y[u]), (less, x[u])) for u in range(3)]
            return out
        rest = lines.let(f"1.0f - {c}")
        x, y, z = axis
        turned = [
            [lines.sum(c, (x * x, rest)), lines.sum((x * y, rest), (z, s)), lines.sum((x * z, rest), (-y, s))],
            [lines.sum((x * y, rest), (-z, s)), lines.sum(c, (y * y, rest)), lines.sum((y * z, rest), (x, s))],
            [lines.sum((x * z, rest), (y, s)), lines.sum((y * z, rest), (-x, s)), lines.sum(c, (z * z, rest))],
        ]
        return [self._within(columns, column) for column in turned]

    def _inertia(self, b: int, position: Vector, columns: Matrix) -> Inertia:
        """A body's inertia about the reference."""
        m, lines, model = self.mj, self.lines, self.model
        masses, principal = model.array("body_mass")[:, b], model.array("body_inertia")[:, b]
        if not masses.any():
            return [0.0] * 10
        mass = model.columns.operand(masses)
        turn = rotation(m.body_iquat[b])
        tensor = np.einsum("ik,wk,jk->wij", turn, principal, turn)
        tensor[np.abs(tensor) < 1e-9 * np.abs(tensor).max()] = 0.0
        local = {(i, j): model.columns.operand(tensor[:, i, j]) for i in range(3) for j in range(i, 3)}

        def entry(i: int, j: int) -> Operand:
            return local[min(i, j), max(i, j)]

        # columns of R J, then R J Rᵀ
        half = [self._within(columns, [entry(k, j) for k in range(3)]) for j in range(3)]

        def turned(i: int, j: int) -> Operand:
            return lines.sum(*((half[k][i], columns[k][j]) for k in range(3)))

        about = [turned(0, 0), turned(1, 1), turned(2, 2), turned(0, 1), turned(0, 2), turned(1, 2)]
        centre = lines.transform(columns, known(m.body_ipos[b]), position)
        d = lines.difference(centre, self.reference)
        moment = self._scaled(d, mass)
        square = [lines.sum((moment[k], d[k])) for k in range(3)]
        less = [lines.sum((-1.0, x)) for x in moment]
        return [
            lines.sum(about[0], square[1], square[2]),
            lines.sum(about[1], square[0], square[2]),
            lines.sum(about[2], square[0], square[1]),
            lines.sum(about[3], (less[0], d[1])),
            lines.sum(about[4], (less[0], d[2])),
            lines.sum(about[5], (less[1], d[2])),
            *moment,
            mass,
        ]

    def _times(self, inertia: Inertia, v: Vector) -> Vector:
        """The symmetric part of an inertia times a vector."""
        xx, yy, zz, xy, xz, yz = inertia[:6]
        lines = self.lines
        return [
            lines.sum((xx, v[0]), (xy, v[1]), (xz, v[2])),
            lines.sum((xy, v[0]), (yy, v[1]), (yz, v[2])),
            lines.sum((xz, v[0]), (yz, v[1]), (zz, v[2])),
        ]

    def _sum(self, *vectors: Vector) -> Vector:
        return [self.lines.sum(*parts) for parts in zip(*vectors, strict=True)]

    def _scaled(self, v: Vector, s: Operand) -> Vector:
        return [self.lines.sum((x, s)) for x in v]
