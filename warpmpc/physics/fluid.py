# SPDX-License-Identifier: Apache-2.0
"""Tables for the forces of a medium on bodies as boxes of their inertia (MuJoCo, "Computation: Fluid forces")."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .base import rotation
from .tables import floats, ints

if TYPE_CHECKING:
    from .model import PhysicsModel
    from .sites import Marks


class Medium:
    """Sizes and tables of the bodies that a medium resists.

    Args:
        model: The model.
        marks: Takes the frames of their inertias.
    """

    def __init__(self, model: PhysicsModel, marks: Marks):
        self.model, m = model, model.mj
        there = bool(m.opt.density or m.opt.viscosity) and model.passive
        self.bodies = [b for b in range(1, m.nbody) if there and model.moves(b) and m.body_mass[b] > 0.0]
        self._marks = [marks.index(b, m.body_ipos[b], rotation(m.body_iquat[b])) for b in self.bodies]
        marks.turned.update(self._marks)
        marks.pushed.update(self._marks)

    @property
    def sizes(self) -> dict[str, int]:
        """Macros of the source."""
        return {"WET": len(self.bodies)}

    def tables(self) -> list[str]:
        """Definitions of the tables."""
        if not self.bodies:
            return []
        m, model = self.model.mj, self.model
        boxes = [self._box(b) for b in self.bodies]
        wet = [[n for n, b in enumerate(self.bodies) if dof in model.body_dofs[b]] for dof in range(m.nv)]
        return [
            floats("wind", m.opt.wind),
            floats("medium", [m.opt.density, m.opt.viscosity]),
            ints("wet_mark", self._marks),
            floats("wet_box", [box[0] for box in boxes]),
            ints("wet_box_at", [[model.columns.index(box[:, k]) for k in range(3)] for box in boxes]),
            ints("wet_first", np.cumsum([0, *(len(row) for row in wet)])),
            ints("wet_body", [n for row in wet for n in row]),
        ]

    def _box(self, body: int) -> np.ndarray:
        """Edges of a solid box of a body's mass and inertia, ``[W, 3]`` or ``[1, 3]`` [m]."""
        mass, inertia = self.model.array("body_mass")[:, body, None], self.model.array("body_inertia")[:, body]
        rest = inertia.sum(axis=1, keepdims=True) - 2.0 * inertia
        return np.sqrt(np.maximum(rest, 1e-15) * 6.0 / mass)
