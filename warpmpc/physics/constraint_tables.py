# SPDX-License-Identifier: Apache-2.0
"""Sizes and tables of ties and of the friction of joints, for ``native/ties.h``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .base import packed
from .tables import floats, ints

if TYPE_CHECKING:
    from .model import PhysicsModel


class TieTables:
    """Sizes and tables of the rows.

    Args:
        model: The model.
    """

    def __init__(self, model: PhysicsModel):
        self.model = model
        self.rows = [(tie, inverse) for tie in model.ties for inverse in tie.inverse]
        """Of all ties, one after the other."""

    @property
    def sizes(self) -> dict[str, int]:
        """Macros of the source."""
        longest = max([1, *(len(tie.dofs) for tie in self.model.ties)])
        return {"TIES": len(self.rows), "TIE_DOFS": longest, "DRY": len(self.model.dry)}

    def tables(self) -> list[str]:
        """Definitions of the tables."""
        out = []
        if self.rows:
            longest, above, index = self.sizes["TIE_DOFS"], self.model.ancestors, self.model.columns.index
            dofs, entries = (
                np.zeros((len(self.rows), longest), int),
                np.zeros((len(self.rows), packed(longest, 0)), int),
            )
            for k, (tie, _) in enumerate(self.rows):
                dofs[k, : len(tie.dofs)] = tie.dofs
                for a, i in enumerate(tie.dofs):
                    for b, j in enumerate(tie.dofs[: a + 1]):
                        entries[k, packed(a, b)] = packed(max(i, j), min(i, j))
            couples = [any(j not in above[i] for i in tie.dofs for j in tie.dofs if j < i) for tie, _ in self.rows]
            out += [
                ints("tie_count", [len(tie.dofs) for tie, _ in self.rows]),
                ints("tie_dof", dofs),
                ints("tie_entry", entries, "short"),
                ints("tie_couples", couples),
                ints("tie_inverse_at", [index(inverse) for _, inverse in self.rows]),
                floats("tie_stiffness", [tie.rows.stiffness for tie, _ in self.rows]),
                floats("tie_damping", [tie.rows.damping for tie, _ in self.rows]),
                floats("tie_impedance", self.model.impedances([tie.rows for tie, _ in self.rows])),
                floats("tie_low", [tie.low for tie, _ in self.rows]),
                floats("tie_high", [tie.high for tie, _ in self.rows]),
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
