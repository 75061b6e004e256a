# SPDX-License-Identifier: Apache-2.0
"""Source of what does not branch: what stands still, what moves (:mod:`.tree`), and forces (:mod:`.drive`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..bake.lines import Lines, Matrix, Vector, function
from .base import IDENTITY, NOTHING, rotation
from .bodies import Bodies
from .constraint_rows import ConstraintRows
from .coriolis import write_skewed_solve
from .drive import Drive
from .fluid import Fluid
from .gyroscopic import write_gyroscopic
from .sensing import Sensing
from .tendons import Tendons
from .tree import Tree

if TYPE_CHECKING:
    from .model import PhysicsModel


class Dynamics:
    """Writes ``place`` (once a rollout), ``stretch``, ``drive`` (before a step), ``gyroscopic`` and ``move`` (after).

    Args:
        model: The model.
        recorded: Bodies whose poses and velocities are kept for the record.
        sensors: Whether sensors are read.
    """

    def __init__(self, model: PhysicsModel, recorded: frozenset[int], *, sensors: bool = False):
        self.model, self.mj, self.recorded = model, model.mj, recorded
        self.bodies = Bodies(model, recorded)
        self.sites = self.bodies.sites
        self.tendons = Tendons(model, self.sites)
        self.sensing = Sensing(model, self.sites, self.tendons, on=sensors)
        self.drive = Drive(model, self.sites, self.tendons, kept=self.sensing.drives)

    def write(self) -> str:
        """Source of the functions."""
        # these ask for sites
        forces = self.tendons.write(), self.drive.write(), write_gyroscopic(self.model, self.drive)
        skewed = write_skewed_solve(self.model, self.drive.spreads)
        self.fluid = Fluid(self.model, self.sites)
        self.bind = ConstraintRows(self.model, self.sites, self.tendons).write()
        self.sense = self.sensing.write()
        return "\n".join((*forces, skewed, self._place(), self._move()))

    def _place(self) -> str:
        """Place what stands still: geoms fixed to the world, and those of mocap bodies, whose poses are given."""
        lines, m = Lines("p"), self.mj
        frames: dict[int, tuple[Matrix, Vector]] = {0: (IDENTITY, NOTHING)}
        for body in range(1, m.nbody):
            if self.model.moves(body):
                continue
            if m.body_mocapid[body] >= 0:
                first = 7 * int(m.body_mocapid[body])
                position = [lines.let(f"w.mocap[{first + k}]") for k in range(3)]
                columns = self.bodies.columns(lines, [lines.let(f"w.mocap[{first + 3 + k}]") for k in range(4)])
            else:
                columns, position = frames[int(m.body_parentid[body])]
                position = lines.transform(columns, m.body_pos[body], position)
                columns = lines.times(columns, rotation(m.body_quat[body]))
            frames[body] = columns, position
            if body in self.recorded:
                self.bodies.keep(lines, body, position, columns, (NOTHING, NOTHING))
        for body, (columns, position) in frames.items():
            self.bodies.geoms(lines, body, position, columns)
            self.sites.write(lines, body, position, columns, None)
        for i, g in enumerate(self.model.standing):
            if g in self.bodies.used:
                first = f"GIVEN_POSE + {12 * i}"
                lines.add(f"for (int i = 0; i < 3; ++i) w.gpos[{g}][i] = splat(w.given[{first} + i]);")
                lines.add(f"for (int i = 0; i < 9; ++i) w.gmat[{g}][i] = splat(w.given[{first} + 3 + i]);")
        return function("place", lines)

    def _move(self) -> str:
        """Poses of bodies and geoms, axes, mass matrix and bias forces, from coordinates and velocities."""
        m, lines = self.mj, Lines("m")
        roots = [b for b in range(1, m.nbody) if self.model.moves(b) and not self.model.moves(int(m.body_parentid[b]))]
        for root in roots:
            Tree(self.bodies, lines, root).write()
        return "\n".join(("#if !COOPERATE  // a warp has its own, native/links.h", function("move", lines), "#endif"))
