# SPDX-License-Identifier: Apache-2.0
"""Source of what does not branch: where everything is, the mass matrix, and the forces of bias, joints and drives.

Spatial vectors are taken about a point of their own for every tree (where its first moving body is), which keeps
single precision good far from the origin: composite rigid bodies and Newton-Euler as in Featherstone, "Rigid Body
Dynamics Algorithms" (2008), chapters 5 and 6.
"""

from __future__ import annotations

import mujoco
import numpy as np

from ...bake.lines import Lines, Matrix, Operand, Vector, known, literal, text
from ...bake.number import sincos
from .model import BALL, BOX, CONVEX, CYLINDER, ELLIPSOID, FREE, MESH, SLIDE, PhysicsModel, rotation

Inertia = list[Operand]
"""Of a body about the tree's point: xx, yy, zz, xy, xz, yz, mass times centre (3), mass."""

NOTHING: Vector = [0.0, 0.0, 0.0]
IDENTITY: Matrix = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


def packed(i: int, j: int) -> int:
    """Place of entry (i, j), j ≤ i, of a symmetric matrix that is kept by rows."""
    return i * (i + 1) // 2 + j


class Dynamics:
    """Writes ``place`` (once per rollout), ``drive`` (before every step), ``spin`` (within it) and ``move`` (after it).

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

    def write(self) -> str:
        """Source of the functions."""
        return "\n".join((self._place(), self._move(), self._drive(), self._spin()))

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
                columns = self._columns(lines, [lines.let(f"w.mocap[{first + 3 + k}]") for k in range(4)])
            else:
                columns, position = frames[int(m.body_parentid[body])]
                position = lines.transform(columns, m.body_pos[body], position)
                columns = lines.times(columns, rotation(m.body_quat[body]))
            frames[body] = columns, position
            if body in self.recorded:
                self._keep(lines, body, position, columns, (NOTHING, NOTHING))
        for body, (columns, position) in frames.items():
            self._geoms(lines, body, position, columns)
        for i, g in enumerate(self.model.standing):
            if g in self.used:
                first = f"GIVEN_POSE + {12 * i}"
                lines.add(f"for (int i = 0; i < 3; ++i) w.gpos[{g}][i] = splat(w.given[{first} + i]);")
                lines.add(f"for (int i = 0; i < 9; ++i) w.gmat[{g}][i] = splat(w.given[{first} + 3 + i]);")
        return self._function("place", lines)

    def _move(self) -> str:
        """Poses of bodies and geoms, axes, mass matrix and bias forces, from coordinates and velocities."""
        m, lines = self.mj, Lines("m")
        roots = [b for b in range(1, m.nbody) if self.model.moves(b) and not self.model.moves(int(m.body_parentid[b]))]
        for root in roots:
            _Tree(self, lines, root).write()
        return self._function("move", lines)

    def _drive(self) -> str:
        """Forces of bias, springs, dampers and actuators, and what velocity damps of them within an implicit step."""
        m, lines = self.mj, Lines("d")
        implicit = m.opt.integrator == int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
        force: dict[int, list] = {i: [] for i in range(m.nv)}
        damped: dict[int, list] = {i: [] for i in range(m.nv)}
        disabled = m.opt.disableflags
        for a in range(m.nu):
            if disabled & mujoco.mjtDisableBit.mjDSBL_ACTUATION:
                break
            dof = int(m.jnt_dofadr[m.actuator_trnid[a, 0]])
            value, rate = self._actuator(lines, a, dof)
            force[dof].append((value, float(m.actuator_gear[a, 0])))
            if implicit and rate != 0.0:
                damped[dof].append((rate, -(float(m.actuator_gear[a, 0]) ** 2)))
        for i in range(m.nv):
            q = self.model.dof_coordinate[i]
            driven = lines.sum(*force[i])
            joint = int(m.dof_jntid[i])
            if force[i] and m.jnt_actfrclimited[joint]:
                driven = self._clamp(lines, driven, m.jnt_actfrcrange[joint])
            terms: list = [driven, (-1.0, lines.let(f"w.bias[{i}]"))]
            damping, stiffness = float(m.dof_damping[i]), float(np.ravel(m.jnt_stiffness)[joint]) if q >= 0 else 0.0
            if damping:
                terms.append((-damping, f"w.v[{i}]"))
                damped[i].append(damping)
            if stiffness:
                terms += [(-stiffness, f"w.q[{q}]"), stiffness * float(m.qpos_spring[q])]
            lines.add(f"w.fs[{i}] = {text(lines.sum(*terms))};")
            rate = lines.sum(*damped[i])
            lines.add(f"w.damp[{i}] = {text(rate)} * {literal(float(m.opt.timestep))};")
        return self._function("drive", lines)

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
        return self._function("spin", lines)

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

    def _actuator(self, lines: Lines, a: int, dof: int) -> tuple[Operand, Operand]:
        """Force of an actuator, and its derivative by the velocity of its joint, over its gear."""
        m, q = self.mj, self.model.dof_coordinate[dof]
        gear, gain, bias = float(m.actuator_gear[a, 0]), m.actuator_gainprm[a], m.actuator_biasprm[a]
        control: Operand = f"w.ctrl[{a}]"
        if m.actuator_ctrllimited[a]:
            control = self._clamp(lines, control, m.actuator_ctrlrange[a])
        affine = int(m.actuator_gaintype[a]) == int(mujoco.mjtGain.mjGAIN_AFFINE)
        factor: Operand = float(gain[0])
        if affine:
            factor = lines.sum(
                float(gain[0]), (float(gain[1]) * gear, f"w.q[{q}]"), (float(gain[2]) * gear, f"w.v[{dof}]")
            )
        terms: list = [(factor, control)]
        rate: list = [(float(gain[2]), control)] if affine and gain[2] else []
        if int(m.actuator_biastype[a]) == int(mujoco.mjtBias.mjBIAS_AFFINE):
            terms += [
                float(bias[0]),
                (float(bias[1]) * gear, f"w.q[{q}]"),
                (float(bias[2]) * gear, f"w.v[{dof}]"),
            ]
            rate.append(float(bias[2]))
        force, slope = lines.sum(*terms), lines.sum(*rate)
        if m.actuator_forcelimited[a] and isinstance(force, str):
            low, high = (literal(float(x)) for x in m.actuator_forcerange[a])
            if slope != 0.0:  # a force at its limit does not depend on velocity
                slope = lines.let(f"VSELECT(({force} > {low}) & ({force} < {high}), {text(slope)}, (T)0.0f)")
            force = self._clamp(lines, force, m.actuator_forcerange[a])
        return force, slope

    def _clamp(self, lines: Lines, value: Operand, bounds: np.ndarray) -> Operand:
        if isinstance(value, float):
            return float(np.clip(value, *bounds))
        low, high = (literal(float(x)) for x in bounds)
        return lines.let(f"VMIN(VMAX({value}, (T){low}), (T){high})")

    def _columns(self, lines: Lines, q: list[str]) -> Matrix:
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

    def _geoms(self, lines: Lines, body: int, position: Vector, columns: Matrix) -> None:
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

    def _keep(
        self, lines: Lines, body: int, position: Vector, columns: Matrix, velocity: tuple[Vector, Vector]
    ) -> None:
        """Keep a body's pose, its angular velocity, and the linear one at its origin."""
        row = sorted(self.recorded).index(body)
        for k in range(3):
            lines.add(f"w.bpos[{row}][{k}] = {text(position[k])};")
            lines.add(f"w.bang[{row}][{k}] = {text(velocity[0][k])};")
            lines.add(f"w.blin[{row}][{k}] = {text(velocity[1][k])};")
            for axis in range(3):
                lines.add(f"w.bmat[{row}][{3 * k + axis}] = {text(columns[axis][k])};")

    def _function(self, name: str, lines: Lines) -> str:
        return f"FN void {name}(World& w) {{\n" + "\n".join(lines.statements) + "\n}"


class _Tree:
    """Writes one tree, depth first, so that few values live long.

    Args:
        dynamics: What it is written for.
        lines: Takes the statements.
        root: First body that joints move.
    """

    def __init__(self, dynamics: Dynamics, lines: Lines, root: int):
        self.dynamics, self.lines, self.root = dynamics, lines, root
        self.model, self.mj = dynamics.model, dynamics.mj
        self.reference: Vector | None = None
        """The point that spatial vectors are taken about."""
        self.turns: dict[int, Vector] = {}
        """Angular part of every axis."""
        self.slides: dict[int, Vector] = {}
        """Linear part of every axis, at the reference."""

    def write(self) -> None:
        """Write the tree."""
        parent, m = int(self.mj.body_parentid[self.root]), self.mj
        columns, position = IDENTITY, NOTHING
        if parent:
            columns, position = self._fixed(parent)
        gravity = [0.0 if m.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY else float(x) for x in m.opt.gravity]
        self.gravity = gravity
        self._visit(self.root, position, columns, (NOTHING, NOTHING, NOTHING, [-x for x in gravity]))

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

    def _visit(self, b: int, position: Vector, columns: Matrix, motion: tuple) -> tuple[Inertia, Vector, Vector]:
        """Inertia and force of everything from a body on."""
        m, lines = self.mj, self.lines
        if not m.body_jntnum[b] or m.jnt_type[m.body_jntadr[b]] != FREE:  # whose pose is all in its coordinates
            position = lines.transform(columns, known(m.body_pos[b]), position)
            columns = lines.times(columns, rotation(m.body_quat[b]))
        for j in range(m.body_jntadr[b], m.body_jntadr[b] + m.body_jntnum[b]):
            position, columns, motion = self._joint(j, position, columns, motion)
        own = range(m.body_dofadr[b], m.body_dofadr[b] + m.body_dofnum[b]) if m.body_dofnum[b] else range(0)
        for i in own:
            for k in range(3):
                lines.add(f"w.cw[{i}][{k}] = {text(self.turns[i][k])};")
                lines.add(f"w.cl[{i}][{k}] = {text(self.slides[i][k])};")
        self.dynamics._geoms(lines, b, position, columns)
        if self.reference is None:
            self._refer(position)
        angular, linear, turning, falling = motion
        if b in self.dynamics.recorded:
            arm = lines.difference(position, self.reference)
            at_origin = self._sum(linear, lines.cross(angular, arm))
            self.dynamics._keep(lines, b, position, columns, (angular, at_origin))
        inertia = self._inertia(b, position, columns)
        share = float(m.body_gravcomp[b])
        felt = [self.lines.sum(x, share * g) for x, g in zip(falling, self.gravity, strict=True)] if share else falling
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
        for child in np.flatnonzero(m.body_parentid == b):
            if child <= b:
                continue
            more, torque_of, force_of = self._visit(int(child), position, columns, motion)
            inertia = [lines.sum(x, y) for x, y in zip(inertia, more, strict=True)]
            torque, force = self._sum(torque, torque_of), self._sum(force, force_of)
        self._axes(own, inertia, torque, force)
        return inertia, torque, force

    def _axes(self, own: range, inertia: Inertia, torque: Vector, force: Vector) -> None:
        """Mass matrix and bias of a body's degrees of freedom."""
        m, lines, moment = self.mj, self.lines, inertia[6:9]
        for i in own:
            turn = self._sum(self._times(inertia, self.turns[i]), lines.cross(moment, self.slides[i]))
            push = lines.difference(self._scaled(self.slides[i], inertia[9]), lines.cross(moment, self.turns[i]))
            for j in [i, *self.model.ancestors[i]]:
                products = [*zip(self.turns[j], turn, strict=True), *zip(self.slides[j], push, strict=True)]
                entry = lines.sum(*products, float(m.dof_armature[i]) if i == j else 0.0)
                lines.add(f"w.mm[{packed(i, j)}] = {text(entry)};")
            products = [*zip(self.turns[i], torque, strict=True), *zip(self.slides[i], force, strict=True)]
            lines.add(f"w.bias[{i}] = {text(lines.sum(*products))};")

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
        return self.dynamics._columns(lines, [lines.let(f"{x} * {scale}") for x in q])

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
