# SPDX-License-Identifier: Apache-2.0
"""Sizes and tables of constraints and of the friction of joints, for ``native/constraints.h``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .base import packed
from .tables import floats, ints

if TYPE_CHECKING:
    from .model import PhysicsModel


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
    def sizes(self) -> dict[str, int]:
        """Macros of the source."""
        longest = max([1, *(len(constraint.dofs) for constraint in self.model.constraints)])
        return {"CONSTRAINTS": len(self.rows), "CONSTRAINT_DOFS": longest, "DRY": len(self.model.dry)}

    def tables(self) -> list[str]:
        """Definitions of the tables."""
        out = []
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
