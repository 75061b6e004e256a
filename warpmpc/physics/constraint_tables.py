# SPDX-License-Identifier: Apache-2.0
"""Sizes and tables of constraints, of the friction of joints and of the solver."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..bake.lines import literal
from .base import packed
from .tables import floats, ints

if TYPE_CHECKING:
    from .model import PhysicsModel


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
