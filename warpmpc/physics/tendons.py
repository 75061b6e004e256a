# SPDX-License-Identifier: Apache-2.0
"""Source of tendons: their lengths, and how joints change them (MuJoCo, "Computation: Tendons")."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from .base import WRAP_CYLINDER, WRAP_JOINT, WRAP_PULLEY, WRAP_SITE, packed, rotation, wraps
from .coefficients import coefficient, negative, powers, within
from .runtime.bake import Lines, Operand, Vector, angle, literal, sincos, text
from .source_parts import ints

if TYPE_CHECKING:
    import mujoco

    from .base import Structure
    from .frames import Sites


class Tendons:
    """Writes ``stretch``: lengths of all tendons, their speeds, and the lever arms of those along sites.

    Args:
        model: The model.
        sites: Takes the sites.
    """

    def __init__(self, model: Structure, sites: Sites):
        self.model, self.mj, self.sites = model, model.mj, sites
        self._wraps = 0

    @cached_property
    def _arms(self) -> dict[tuple[int, int], int]:
        """Place of the lever arm of each tendon along sites and each of its degrees of freedom."""
        spatial = [n for n in range(self.mj.ntendon) if not fixed(self.mj, n)]
        pairs = [(n, dof) for n in spatial for dof in self.model.tendon_dofs[n]]
        return {pair: at for at, pair in enumerate(pairs)}

    def heavy(self, tendon: int) -> bool:
        """Return whether a tendon along sites has an armature, whose part of the mass matrix changes."""
        return self.model.line_armatures[tendon] > 0.0 and not fixed(self.mj, tendon)

    @cached_property
    def masses(self) -> dict[tuple[int, int], int]:
        """Number of each entry (row, column ≤ row) of the mass matrix that armatures of these tendons add to."""
        heavy, above = filter(self.heavy, range(self.mj.ntendon)), self.model.ancestors
        dofs = [self.model.tendon_dofs[n] for n in heavy]
        entries = {(i, j) for row in dofs for i in row for j in row if j == i or j in above[i]}
        return {entry: n for n, entry in enumerate(sorted(entries))}

    def tables(self) -> list[str]:
        """Definitions of tables."""
        return [ints("tendon_mass_place", [packed(i, j) for i, j in self.masses], "short")] if self.masses else []

    @property
    def sizes(self) -> dict[str, int]:
        """Macros of the source."""
        return {
            "TENDONS": self.mj.ntendon,
            "TENDON_ARMS": max(1, len(self._arms)),
            "WRAPS": self._wraps,
            "TENDON_MASSES": len(self.masses),
        }

    def arms(self, tendon: int) -> list[tuple[int, Operand]]:
        """Degrees of freedom of a tendon, and what each adds to its length [m per unit]."""
        m, dofs = self.mj, self.model.tendon_dofs[tendon]
        if not fixed(m, tendon):
            return [(dof, f"w.tendon_arm[{self._arms[tendon, dof]}]") for dof in dofs]
        factors = dict.fromkeys(dofs, 0.0)
        for k in wraps(m, tendon):
            factors[int(m.jnt_dofadr[m.wrap_objid[k]])] += float(m.wrap_prm[k])
        return list(factors.items())

    def write(self) -> str:
        """Source of the function."""
        if not self.mj.ntendon:
            return ""
        lines = Lines("t")
        for n in range(self.mj.ntendon):
            length = self._fixed(lines, n) if fixed(self.mj, n) else self._spatial(lines, n)
            lines.add(f"w.tendon_length[{n}] = {text(length)};")
            speed = lines.sum(*((factor, f"w.v[{dof}]") for dof, factor in self.arms(n)))
            lines.add(f"w.tendon_speed[{n}] = {text(speed)};")
        self._weigh(lines)
        return "FN void stretch(World& w) {\n" + "\n".join(lines.statements) + "\n}"

    def _weigh(self, lines: Lines) -> None:
        """What armatures add to entries of the mass matrix."""
        rows = [
            (float(self.model.line_armatures[n]), dict(self.arms(n))) for n in range(self.mj.ntendon) if self.heavy(n)
        ]
        for (i, j), n in self.masses.items():
            parts = [(a, lines.sum((arms[i], arms[j]))) for a, arms in rows if i in arms and j in arms]
            lines.add(f"w.tendon_mass[{n}] = {text(lines.sum(*parts))};")

    def force(self, lines: Lines, tendon: int) -> tuple[Operand, Operand]:
        """Force of a tendon's spring and damper [N], and its slope by speed, with the other sign [N s/m]."""
        m, terms = self.mj, []
        springs = powers(m, "tendon_stiffness")[tendon]
        if springs.any() and not self.model.off("SPRING"):
            low, high = (float(x) for x in within(m.tendon_lengthspring[tendon]))
            length = f"w.tendon_length[{tendon}]"
            rest: Operand = low
            if low != high:
                rest = lines.let(f"VMIN(VMAX({length}, (T){literal(low)}), (T){literal(high)})")
            if springs[1:].any():
                away = lines.sum(length, (-1.0, rest))
                terms.append((negative(lines, coefficient(lines, springs, away, damper=False)[0]), away))
            else:
                terms += [(-float(springs[0]), length), (float(springs[0]), rest)]
        speed = f"w.tendon_speed[{tendon}]"
        damping, slope = coefficient(lines, self.model.line_dampings[tendon], speed, damper=True)
        if damping != 0.0:
            terms.append((negative(lines, damping), speed))
        return lines.sum(*terms), slope

    def _fixed(self, lines: Lines, tendon: int) -> Operand:
        """Length of a sum of joint coordinates."""
        m = self.mj
        return lines.sum(
            *(
                (float(m.wrap_prm[k]), f"w.q[{int(m.jnt_qposadr[m.wrap_objid[k]])}]")
                for k in wraps(m, tendon)
                if m.wrap_prm[k]
            )
        )

    def _spatial(self, lines: Lines, tendon: int) -> Operand:
        """Length along sites and around shapes; its lever arms are written down."""
        m, sites = self.mj, self.sites
        arms: dict[int, list] = {dof: [] for dof in self.model.tendon_dofs[tendon]}
        lengths: list[Operand | tuple[Operand, Operand]] = []
        divisor, last, shape, curving = 1.0, -1, -1, []
        for k in wraps(m, tendon):
            if m.wrap_type[k] == WRAP_PULLEY:
                divisor, last = float(m.wrap_prm[k]), -1
                continue
            if m.wrap_type[k] != WRAP_SITE:
                shape = k
                continue
            site = int(m.wrap_objid[k])
            if last >= 0:
                bodies = [int(m.site_bodyid[s]) for s in (last, site)]
                if shape >= 0:
                    length = self._around(lines, arms, (last, site), shape, divisor)
                elif bodies[0] == bodies[1]:
                    length = float(np.linalg.norm(m.site_pos[site] - m.site_pos[last]))
                else:
                    ends = [sites.index(m.site_bodyid[s], m.site_pos[s]) for s in (last, site)]
                    way, length = self._span(lines, *ends)
                    points = [(body, sites.point(end)) for body, end in zip(bodies, ends, strict=True)]
                    self._pull(lines, arms, *points, way, divisor)
                    if self.heavy(tendon):
                        curving.append((1.0 / divisor, self._curve(lines, ends, way, length)))
                lengths.append((1.0 / divisor, length))
            last, shape = site, -1
        for dof, parts in arms.items():
            lines.add(f"w.tendon_arm[{self._arms[tendon, dof]}] = {text(lines.sum(*parts))};")
        if self.heavy(tendon):
            lines.add(f"w.tendon_curving[{tendon}] = {text(lines.sum(*curving))};")
        return lines.sum(*lengths)

    def _curve(self, lines: Lines, ends: list[int], way: Vector, length: Operand) -> Operand:
        """Acceleration of the distance of two sites while no joint accelerates."""
        sites, (a, b) = self.sites, ends
        fast, falling = (lines.difference(motion(b), motion(a)) for motion in (sites.speed, sites.falling))
        along = lines.dot(way, fast)
        across = [lines.sum(x, (-1.0, lines.sum((along, y)))) for x, y in zip(fast, way, strict=True)]
        swept = lines.let(f"{text(lines.dot(across, across))} / VMAX({length}, (T)1e-12f)")
        return lines.sum(lines.dot(way, falling), swept)

    def _around(self, lines: Lines, arms: dict[int, list], ends: tuple[int, int], k: int, divisor: float) -> Operand:
        """Length between two sites around a shape (``native/wrap.h``)."""
        m, sites, self._wraps = self.mj, self.sites, self._wraps + 1
        geom, side = int(m.wrap_objid[k]), round(float(m.wrap_prm[k]))
        frame = sites.index(m.geom_bodyid[geom], m.geom_pos[geom], rotation(m.geom_quat[geom]))
        sites.columns(frame)
        marks = [sites.index(m.site_bodyid[s], m.site_pos[s]) for s in ends]
        beside = f"w.site_at[{sites.index(m.site_bodyid[side], m.site_pos[side])}]" if side >= 0 else "nullptr"
        bend, cylinder = f"bend{self._wraps}", int(m.wrap_type[k] == WRAP_CYLINDER)
        places = ", ".join(f"w.site_at[{n}]" for n in (*marks, frame))
        shape = f"w.site_turn[{frame}], gsize(w, {geom}, 0), {cylinder}, {beside}"
        lines.add(f"const Bend {bend} = around({places}, {shape});")
        first, last, before, after = (
            [f"{bend}.{name}.{axis}" for axis in "xyz"] for name in ("first", "last", "in", "out")
        )
        body = int(m.geom_bodyid[geom])
        outer = [(int(m.site_bodyid[s]), sites.point(n)) for s, n in zip(ends, marks, strict=True)]
        self._pull(lines, arms, outer[0], (body, first), before, divisor)
        self._pull(lines, arms, (body, last), outer[1], after, divisor)
        return f"{bend}.length"

    def _pull(
        self,
        lines: Lines,
        arms: dict[int, list],
        start: tuple[int, Vector],
        end: tuple[int, Vector],
        way: Vector,
        divisor: float,
    ) -> None:
        """What joints add to the length from one point to another, each on a body, in a direction."""
        chains = [self.model.body_dofs[body] for body, _ in (start, end)]
        for (_, point), own, other, sign in ((start, *chains, -1.0), (end, *chains[::-1], 1.0)):
            twists: dict[int, Vector] = {}
            for dof in sorted(own - other):
                top = self.model.dof_top[dof]
                arm = [*zip(way, (f"w.cl[{dof}][{k}]" for k in range(3)), strict=True)]
                if not self.model.slides(dof):
                    if top not in twists:
                        reach = lines.difference(point, [f"w.ref[{top}][{k}]" for k in range(3)])
                        twists[top] = lines.cross(reach, way)
                    arm += zip(twists[top], self.sites.axis(dof), strict=True)
                arms[dof].append((sign / divisor, lines.sum(*arm)))

    def _span(self, lines: Lines, a: int, b: int) -> tuple[Vector, Operand]:
        """Direction from one site to another, along x where they are one, and their distance [m]."""
        way = lines.difference(self.sites.point(b), self.sites.point(a))
        length = lines.let(f"VSQRT({text(lines.dot(way, way))})")
        over = lines.let(f"1.0f / VMAX({length}, (T)1e-12f)")
        return [lines.sum((x, over)) for x in way], length


def with_angles(source: str) -> str:
    """Source of ``native/wrap.h`` with its functions of angles."""
    turned = source.replace("SINCOS_ANGLE", sincos("angle", "sine", "cosine"))
    return turned.replace("ANGLE", angle("height", "run", "part"))


def fixed(m: mujoco.MjModel, tendon: int) -> bool:
    """Return whether a tendon is a sum of joint coordinates."""
    return int(m.wrap_type[m.tendon_adr[tendon]]) == WRAP_JOINT
