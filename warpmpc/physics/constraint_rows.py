# SPDX-License-Identifier: Apache-2.0
"""Source of the Jacobians, distances and speeds of constraints (MuJoCo, "Computation: Constraint model").

Sizes and tables of constraints, of the friction of joints and of the solver.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from .base import packed, rotation
from .coefficients import within
from .equalities import CONNECT, JOINT, TENDON, Constraint, ends
from .frames import Sites, scaled
from .runtime.bake import Lines, Operand, Vector, angle, literal, text
from .source_parts import floats, ints

if TYPE_CHECKING:
    from .base import Structure
    from .model import PhysicsModel
    from .tendons import Tendons

ALWAYS = "YES"


class ConstraintRows:
    """Writes ``bind``, which gives every constraint's rows to ``constraint``.

    Args:
        model: The model.
        sites: Takes the points and frames of equalities.
        tendons: Lengths and lever arms.
    """

    def __init__(self, model: Structure, sites: Sites, tendons: Tendons):
        self.model, self.mj, self.sites, self.tendons = model, model.mj, sites, tendons
        self._lines, self._count = Lines("b"), 0

    def write(self) -> str:
        """Source of the function."""
        if not self.model.constraints:
            return ""
        for constraint in self.model.constraints:
            {
                "equality": self._equality,
                "ball": self._ball,
                "limit": self._tendon_limit,
                "narrow": self._joint_limit,
                "friction": self._friction,
            }[constraint.kind](constraint)
        return "FN void bind(World& w) {\n" + "\n".join(self._lines.statements) + "\n}"

    def _row(
        self,
        constraint: Constraint,
        jacobian: Mapping[int, Operand],
        distance: Operand,
        *,
        measure: Operand | None = None,
        curving: Operand = 0.0,
        on: str = ALWAYS,
    ) -> None:
        """One row.

        Args:
            constraint: The constraint.
            jacobian: Of its degrees of freedom.
            distance: What is to vanish.
            measure: What its impedance depends on, the distance if None.
            curving: Its acceleration while no joint accelerates.
            on: Lanes in which it holds.
        """
        lines, k = self._lines, self._count
        self._count += 1
        for n, dof in enumerate(constraint.dofs):
            lines.add(f"w.constraint_jac[{k}][{n}] = {text(jacobian.get(dof, 0.0))};")
        rate = lines.sum(*((jacobian[dof], f"w.v[{dof}]") for dof in constraint.dofs if dof in jacobian))
        at = distance if measure is None else measure
        lines.add(f"constraint(w, {k}, {text(distance)}, {text(at)}, {text(rate)}, {text(curving)}, {on});")

    def _equality(self, constraint: Constraint) -> None:
        kind = int(self.mj.eq_type[constraint.index])
        if kind == JOINT:
            self._joints(constraint)
        elif kind == TENDON:
            self._tendons(constraint)
        else:
            self._bodies(constraint)

    def _joints(self, constraint: Constraint) -> None:
        """q₁ - q₁⁰ = Σ cᵢ (q₂ - q₂⁰)ⁱ."""
        m = self.mj
        pair = [int(j) for j in (m.eq_obj1id[constraint.index], m.eq_obj2id[constraint.index])]
        moved = []
        for j in pair:
            q = int(m.jnt_qposadr[j])
            moved.append(self._lines.sum(f"w.q[{q}]", -float(m.qpos0[q])) if j >= 0 else 0.0)
        arms = [{int(m.jnt_dofadr[j]): 1.0} if j >= 0 else {} for j in pair]
        self._coupled(constraint, moved, arms)

    def _tendons(self, constraint: Constraint) -> None:
        """The same for lengths of tendons."""
        m = self.mj
        pair = [int(t) for t in (m.eq_obj1id[constraint.index], m.eq_obj2id[constraint.index])]
        moved = [self._lines.sum(f"w.tendon_length[{t}]", -float(m.tendon_length0[t])) if t >= 0 else 0.0 for t in pair]
        self._coupled(constraint, moved, [dict(self.tendons.arms(t)) if t >= 0 else {} for t in pair])

    def _coupled(self, constraint: Constraint, moved: list[Operand], arms: list[dict[int, Operand]]) -> None:
        """The first of two numbers is a polynomial of the second."""
        lines, c = self._lines, [float(x) for x in self.mj.eq_data[constraint.index, :5]]
        value: Operand = c[4]
        for x in reversed(c[:4]):
            value = lines.sum(x, (value, moved[1]))
        slope: Operand = 4.0 * c[4]
        for power in (3, 2, 1):
            slope = lines.sum(power * c[power], (slope, moved[1]))
        jacobian: dict[int, Operand] = {}
        for dof in constraint.dofs:
            jacobian[dof] = lines.sum(arms[0].get(dof, 0.0), (-1.0, lines.sum((arms[1].get(dof, 0.0), slope))))
        self._row(constraint, jacobian, lines.sum(moved[0], (-1.0, value)))

    def _bodies(self, constraint: Constraint) -> None:
        """Two points are one (connect); two frames are one (weld)."""
        m, e, lines, sites = self.mj, constraint.index, self._lines, self.sites
        bodies = ends(m, e)
        connects, pair = int(m.eq_type[e]) == CONNECT, tied_sites(m, sites, e)
        chains = [self.model.body_dofs[b] for b in bodies]
        apart = lines.difference(sites.point(pair[0]), sites.point(pair[1]))
        curving = lines.difference(sites.falling(pair[0]), sites.falling(pair[1]))
        jacobian: dict[int, Vector] = {}
        for dof in constraint.dofs:
            levers = [
                sites.lever(lines, n, dof) if dof in chain else [0.0] * 3 for n, chain in zip(pair, chains, strict=True)
            ]
            jacobian[dof] = lines.difference(*levers)
        squares = lines.dot(apart, apart)
        bent = None
        if not connects:
            bent = self._turned(constraint, pair, chains, float(m.eq_data[e, 10]))
            squares = lines.sum(squares, lines.dot(bent[0], bent[0]))
        measure = lines.let(f"VSQRT({text(squares)})")
        for k in range(3):
            row = {dof: vector[k] for dof, vector in jacobian.items()}
            self._row(constraint, row, apart[k], measure=measure, curving=curving[k])
        if bent is not None:
            for k in range(3):
                row = {dof: vector[k] for dof, vector in bent[1].items()}
                self._row(constraint, row, bent[0][k], measure=measure, curving=bent[2][k])

    def _turned(
        self, constraint: Constraint, pair: list[int], chains: list[frozenset[int]], scale: float
    ) -> tuple[Vector, dict[int, Vector], Vector]:
        """Rotation of one frame in the other: the quaternion's vector part, its Jacobian, and its acceleration.

        With the relative quaternion (s, e) and angular velocities in the second frame, ė = (s ω + ω × e) / 2.
        """
        lines, sites = self._lines, self.sites
        second = sites.columns(pair[1])
        e, s = relative_turn(lines, sites, pair, f"turn{constraint.index}")

        def bend(omega: Vector) -> Vector:
            local = [lines.dot(column, omega) for column in second]
            swept = lines.cross(local, e)
            return [lines.sum((0.5 * scale, lines.sum((s, x), y))) for x, y in zip(local, swept, strict=True)]

        jacobian: dict[int, Vector] = {}
        for dof in constraint.dofs:
            if self.model.slides(dof) or (dof in chains[0]) == (dof in chains[1]):
                continue
            row = bend(sites.axis(dof))
            jacobian[dof] = row if dof in chains[0] else scaled(lines, row, -1.0)
        gyroscopic_bodies = [sites.spin(n) for n in pair]
        turning = lines.difference(sites.turning(pair[0]), sites.turning(pair[1]))
        spin = lines.difference(*gyroscopic_bodies)
        turning = [lines.sum(a, b) for a, b in zip(turning, lines.cross(*gyroscopic_bodies), strict=True)]
        less = lines.sum((-0.25 * scale, lines.dot(spin, spin)))
        curving = [lines.sum(a, (less, b)) for a, b in zip(bend(turning), e, strict=True)]
        return scaled(lines, e, scale), jacobian, curving

    def _ball(self, constraint: Constraint) -> None:
        """A ball joint's angle has a limit."""
        m, lines, j = self.mj, self._lines, constraint.index
        axis, turn = ball_angle(lines, f"ball{j}", int(m.jnt_qposadr[j]))
        distance = lines.sum(float(m.jnt_range[j].max()), (-1.0, turn))
        on = f"({text(distance)} < {literal(float(m.jnt_margin[j]))})"
        jacobian = {dof: lines.sum((-1.0, x)) for dof, x in zip(constraint.dofs, axis, strict=True)}
        self._row(constraint, jacobian, lines.sum(distance, -float(m.jnt_margin[j])), on=on)

    def _tendon_limit(self, constraint: Constraint) -> None:
        """A tendon is no shorter and no longer than its limits."""
        m, t = self.mj, constraint.index
        arms = dict(self.tendons.arms(t))
        self._limit(constraint, f"w.tendon_length[{t}]", m.tendon_range[t], float(m.tendon_margin[t]), arms)

    def _joint_limit(self, constraint: Constraint) -> None:
        """A coordinate is no smaller and no larger than its limits."""
        m, j = self.mj, constraint.index
        arms: dict[int, Operand] = {constraint.dofs[0]: 1.0}
        self._limit(constraint, f"w.q[{int(m.jnt_qposadr[j])}]", m.jnt_range[j], float(m.jnt_margin[j]), arms)

    def _limit(
        self, constraint: Constraint, value: str, limits: np.ndarray, margin: float, arms: dict[int, Operand]
    ) -> None:
        """One of two limits, or the nearer one."""
        lines, (low, high) = self._lines, (float(x) for x in within(limits))
        above, below = lines.sum(value, -low), lines.sum((-1.0, value), high)
        side: Operand = constraint.sides[0]
        if len(constraint.sides) > 1:
            distance = lines.let(f"VMIN({above}, {below})")
            side = lines.let(f"VSELECT({below} < {above}, (T)-1.0f, (T)1.0f)")
        else:
            distance = above if constraint.sides[0] > 0.0 else below
        on = f"({text(distance)} < {literal(margin)})"
        jacobian = {dof: lines.sum((side, arm)) for dof, arm in arms.items()}
        self._row(constraint, jacobian, lines.sum(distance, -margin), on=on)

    def _friction(self, constraint: Constraint) -> None:
        self._row(constraint, dict(self.tendons.arms(constraint.index)), 0.0)


def tied_sites(m: mujoco.MjModel, sites: Sites, e: int) -> list[int]:
    """Sites of the two bodies of a connect or weld."""
    data, bodies = m.eq_data[e], ends(m, e)
    if int(m.eq_objtype[e]) == int(mujoco.mjtObj.mjOBJ_SITE):
        ids = int(m.eq_obj1id[e]), int(m.eq_obj2id[e])
        return [sites.index(m.site_bodyid[s], m.site_pos[s], rotation(m.site_quat[s])) for s in ids]
    if int(m.eq_type[e]) == CONNECT:
        return [sites.index(b, at) for b, at in zip(bodies, (data[:3], data[3:6]), strict=True)]
    return [sites.index(bodies[0], data[3:6], rotation(data[6:10])), sites.index(bodies[1], data[:3])]


def relative_turn(lines: Lines, sites: Sites, pair: Sequence[int], name: str) -> tuple[Vector, Operand]:
    """Vector part and real part of the quaternion of one site in another's frame.

    Args:
        lines: Takes the statements.
        sites: The sites.
        pair: The one, the other.
        name: What new names begin with.
    """
    first, second = (sites.columns(n) for n in pair)
    entries = [text(lines.dot(second[i], first[j])) for i in range(3) for j in range(3)]
    lines.add(f"T {name}x, {name}y, {name}z, {name}s;")
    lines.add(f"{{ const T r[9] = {{{', '.join(entries)}}};")
    lines.add(f"quaternion(r, {name}x, {name}y, {name}z, {name}s); }}")
    return [f"{name}{axis}" for axis in "xyz"], f"{name}s"


def ball_angle(lines: Lines, name: str, q: int) -> tuple[Vector, Operand]:
    """Axis and angle, not negative, of the quaternion at a coordinate [rad].

    Args:
        lines: Takes the statements.
        name: What new names begin with.
        q: First coordinate.
    """
    x = [f"w.q[{q + 1 + k}]" for k in range(3)]
    length = lines.let(f"VSQRT({' + '.join(f'{a} * {a}' for a in x)})")
    cosine = lines.let(f"VABS(w.q[{q}])")
    lines.add(angle(length, cosine, f"{name}_half"))
    over = lines.let(f"VSELECT(w.q[{q}] < 0.0f, (T)-1.0f, (T)1.0f) / VMAX({length}, (T)1e-20f)")
    return [lines.sum((a, over)) for a in x], lines.sum((2.0, f"{name}_half"))


def small_rotation(lines: Lines, name: str, q: int, rest: np.ndarray) -> Vector:
    """Rotation vector from a known quaternion (w, x, y, z) to the one at a coordinate, in the turned frame [rad]."""
    a, b, c, d = (float(x) for x in rest)
    w, x, y, z = (f"w.q[{q + k}]" for k in range(4))
    real = lines.sum((a, w), (b, x), (c, y), (d, z))
    parts = [
        lines.sum((a, x), (-b, w), (-c, z), (d, y)),
        lines.sum((a, y), (b, z), (-c, w), (-d, x)),
        lines.sum((a, z), (-b, y), (c, x), (-d, w)),
    ]
    return rotation_vector(lines, name, parts, real)


def rotation_vector(lines: Lines, name: str, parts: Vector, real: Operand) -> Vector:
    """Rotation vector of a quaternion by its vector part and its real part [rad]."""
    length = lines.let(f"VSQRT({text(lines.dot(parts, parts))})")
    cosine = lines.let(f"VABS({text(real)})")
    lines.add(angle(length, cosine, f"{name}_half"))
    over = f"VSELECT({text(real)} < 0.0f, (T)-2.0f, (T)2.0f) * {name}_half / VMAX({length}, (T)1e-20f)"
    scale = lines.let(over)
    return [lines.sum((part, scale)) for part in parts]


ROUGHLY = 0.3
"""Share of the slope that a line search may leave: more exact ones save no iterations."""
LINE_SEARCHES = 20
"""Looks of a line search at least, where the solver comes to the minimum whatever way it goes."""
LEAST_SLOPE = 1e-6
"""Share of a slope that rounding may leave of it."""


class ConstraintTables:
    """Sizes and tables of the rows.

    Args:
        model: The model.
    """

    def __init__(self, model: PhysicsModel):
        self.model = model
        self.rows = [(constraint, inverse) for constraint in model.constraints for inverse in constraint.inverse]
        """Of all constraints, one after the other."""

    @property
    def sizes(self) -> dict[str, object]:
        """Macros of the source."""
        model, m = self.model, self.model.mj
        longest = max([1, *(len(constraint.dofs) for constraint in self.model.constraints)])
        return {
            "CONSTRAINTS": len(self.rows),
            "CONSTRAINT_DOFS": longest,
            "DRY": len(model.dry),
            "ITERATIONS": model.iterations[0],
            "FEW": int(model.few),
            "EXPLICIT": int(model.explicit),
            "LINE_SEARCH": max(model.iterations[1], LINE_SEARCHES),
            "LOOKS": literal(float(model.iterations[1])),
            "LEAST_SLOPE": literal(LEAST_SLOPE),
            "TOLERANCE": literal(float(m.opt.tolerance)),
            "WARM": int(not model.off("WARMSTART")),
            "TREES": len(set(model.dof_top)),
            "ROUGHLY": literal(max(ROUGHLY, float(m.opt.ls_tolerance))),
            "LINE_TOLERANCE": literal(float(m.opt.ls_tolerance)),
        }

    def tables(self) -> list[str]:
        """Definitions of the tables."""
        tops = sorted(set(self.model.dof_top))
        out = [ints("dof_tree", [tops.index(top) for top in self.model.dof_top])] if self.model.few else []
        if self.rows:
            longest, above, index = self.sizes["CONSTRAINT_DOFS"], self.model.ancestors, self.model.columns.index
            dofs, entries = (np.zeros((len(self.rows), width), int) for width in (longest, packed(longest, 0)))
            for k, (constraint, _) in enumerate(self.rows):
                dofs[k, : len(constraint.dofs)] = constraint.dofs
                for a, i in enumerate(constraint.dofs):
                    for b, j in enumerate(constraint.dofs[: a + 1]):
                        entries[k, packed(a, b)] = packed(max(i, j), min(i, j))
            couples = [
                any(j not in above[i] for i in constraint.dofs for j in constraint.dofs if j < i)
                for constraint, _ in self.rows
            ]
            out += [
                ints("constraint_count", [len(constraint.dofs) for constraint, _ in self.rows]),
                ints("constraint_dof", dofs),
                ints("constraint_entry", entries, "short"),
                ints("constraint_couples", couples),
                ints("constraint_inverse_at", [index(inverse) for _, inverse in self.rows]),
                floats("constraint_stiffness", [constraint.rows.stiffness for constraint, _ in self.rows]),
                floats("constraint_damping", [constraint.rows.damping for constraint, _ in self.rows]),
                floats("constraint_impedance", self.model.impedances([constraint.rows for constraint, _ in self.rows])),
                floats("constraint_low", [constraint.low for constraint, _ in self.rows]),
                floats("constraint_high", [constraint.high for constraint, _ in self.rows]),
            ]
        if self.model.dry:
            m, inverse = self.model.mj, self.model.array("dof_invweight0")
            soft = [self.model.rows(m.dof_solref[i], m.dof_solimp[i]).slipping for i in self.model.dry]
            out += [
                ints("dry_dof", self.model.dry),
                floats("dry_force", m.dof_frictionloss[self.model.dry]),
                floats("dry_damping", [rows.damping for rows in soft]),
                floats("dry_impedance", [rows.impedance[0] for rows in soft]),
                ints("dry_inverse_at", [self.model.columns.index(inverse[:, i]) for i in self.model.dry]),
            ]
        return out
