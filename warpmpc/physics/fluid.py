# SPDX-License-Identifier: Apache-2.0
"""Tables for the forces of a fluid on bodies as boxes of their inertia (MuJoCo, "Computation: Fluid forces")."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .base import rotation
from .tables import floats, ints

if TYPE_CHECKING:
    from .model import PhysicsModel
    from .sites import Sites


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
