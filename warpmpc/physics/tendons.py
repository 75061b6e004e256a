# SPDX-License-Identifier: Apache-2.0
"""Source of tendons: their lengths, and how joints change them (MuJoCo, "Computation: Tendons")."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import mujoco

from ..bake.lines import Lines, Operand, Vector, literal, text
from .base import WRAP_JOINT, WRAP_PULLEY, wraps
from .limits import within

if TYPE_CHECKING:
    from .base import Structure
    from .sites import Sites


class Tendons:
    """Writes ``stretch``: lengths of all tendons, their speeds, and the lever arms of those along sites.

    Args:
        model: The model.
        sites: Takes the sites.
    """

    def __init__(self, model: Structure, sites: Sites):
        self.model, self.mj, self.sites = model, model.mj, sites

    @cached_property
    def _arms(self) -> dict[tuple[int, int], int]:
        """Place of the lever arm of each tendon along sites and each of its degrees of freedom."""
        spatial = [n for n in range(self.mj.ntendon) if not fixed(self.mj, n)]
        pairs = [(n, dof) for n in spatial for dof in self.model.tendon_dofs[n]]
        return {pair: at for at, pair in enumerate(pairs)}

    @property
    def sizes(self) -> dict[str, int]:
        """Macros of the source."""
        return {"TENDONS": self.mj.ntendon, "TENDON_ARMS": max(1, len(self._arms))}

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
        return "FN void stretch(World& w) {\n" + "\n".join(lines.statements) + "\n}"

    def force(self, lines: Lines, tendon: int) -> Operand:
        """Force of a tendon's spring and damper [N]."""
        m, terms = self.mj, []
        stiffness = 0.0 if self.model.off("SPRING") else float(m.tendon_stiffness[tendon])
        damping = 0.0 if self.model.off("DAMPER") else float(m.tendon_damping[tendon])
        if stiffness:
            low, high = (float(x) for x in within(m.tendon_lengthspring[tendon]))
            length = f"w.tendon_length[{tendon}]"
            if low == high:
                terms += [(-stiffness, length), stiffness * low]
            else:
                rest = lines.let(f"VMIN(VMAX({length}, (T){literal(low)}), (T){literal(high)})")
                terms += [(-stiffness, length), (stiffness, rest)]
        if damping:
            terms.append((-damping, f"w.tendon_speed[{tendon}]"))
        return lines.sum(*terms)

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
        """Length along sites; its lever arms are written down."""
        m, sites = self.mj, self.sites
        arms: dict[int, list] = {dof: [] for dof in self.model.tendon_dofs[tendon]}
        lengths: list[tuple[Operand, Operand]] = []
        divisor, last = 1.0, -1
        for k in wraps(m, tendon):
            if m.wrap_type[k] == WRAP_PULLEY:
                divisor, last = float(m.wrap_prm[k]), -1
                continue
            site = int(m.wrap_objid[k])
            if last >= 0:
                ends = [sites.index(m.site_bodyid[s], m.site_pos[s]) for s in (last, site)]
                way, length = self._span(lines, *ends)
                lengths.append((1.0 / divisor, length))
                chains = [self.model.body_dofs[m.site_bodyid[s]] for s in (last, site)]
                for dof in sorted(chains[0] ^ chains[1]):
                    end, sign = (ends[1], 1.0) if dof in chains[1] else (ends[0], -1.0)
                    arms[dof].append((sign / divisor, lines.dot(way, sites.lever(lines, end, dof))))
            last = site
        for dof, parts in arms.items():
            lines.add(f"w.tendon_arm[{self._arms[tendon, dof]}] = {text(lines.sum(*parts))};")
        return lines.sum(*lengths)

    def _span(self, lines: Lines, a: int, b: int) -> tuple[Vector, Operand]:
        """Direction from one site to another, and their distance [m]."""
        way = lines.difference(self.sites.point(b), self.sites.point(a))
        length = lines.let(f"VSQRT({text(lines.dot(way, way))})")
        over = lines.let(f"1.0f / VMAX({length}, (T)1e-12f)")
        return [lines.sum((x, over)) for x in way], length


def fixed(m: mujoco.MjModel, tendon: int) -> bool:
    """Return whether a tendon is a sum of joint coordinates."""
    return int(m.wrap_type[m.tendon_adr[tendon]]) == WRAP_JOINT
