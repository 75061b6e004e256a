# SPDX-License-Identifier: Apache-2.0
"""Tables of the moving bodies for the lanes of a warp, which go through the trees level by level (``native/levels.h``).

What :mod:`.tree` writes out as straight-line code, which suits one thread with many worlds, all lanes of a warp would
do alike; here each takes a body, an axis or an entry of the mass matrix.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from .model import rotation
from .tables import floats, ints
from .tree import packed

if TYPE_CHECKING:
    from .dynamics import Dynamics


class Levels:
    """Sizes and tables of the moving bodies of a model.

    Args:
        dynamics: Says which geoms and bodies are wanted.
    """

    def __init__(self, dynamics: Dynamics):
        self.dynamics, self.model, self.mj = dynamics, dynamics.model, dynamics.mj
        self.bodies = [b for b in range(1, self.mj.nbody) if self.model.moves(b)]
        """In MuJoCo's order: what hangs on a body follows it."""
        self._row = {b: n for n, b in enumerate(self.bodies)}
        self._depth: list[int] = []
        for b in self.bodies:
            above = self._row.get(int(self.mj.body_parentid[b]))
            self._depth.append(0 if above is None else self._depth[above] + 1)
        used = [g for g in range(self.mj.ngeom) if g in dynamics.used and g not in self.model.standing]
        self._geoms = [g for g in used if int(self.mj.geom_bodyid[g]) in self._row]
        self._kept = [b for b in sorted(dynamics.recorded) if b in self._row]

    @property
    def sizes(self) -> dict[str, int]:
        """Macros of the source."""
        nv = self.mj.nv
        return {
            "MOVING": max(1, len(self.bodies)),
            "LEVELS": max(self._depth, default=-1) + 1,
            "MOVING_GEOMS": len(self._geoms),
            "KEPT": len(self._kept),
            "ENTRIES": sum(1 + len(self.model.ancestors[i]) for i in range(nv)),
            "MASSES_VARY": int((self._mass_at >= 0).any()),
        }

    def tables(self) -> list[str]:
        """Definitions of the tables, for a warp alone."""
        m, model = self.mj, self.model
        order = sorted(range(len(self.bodies)), key=lambda n: (self._depth[n], n))
        count = [self._depth.count(level) for level in range(max(self._depth, default=-1) + 1)]
        places = [self._place(b) for b in self.bodies]
        joints = range(m.njnt)
        dof_body = [self._row[int(b)] for b in m.dof_bodyid]
        entries = [(i, j) for i in range(m.nv) for j in [i, *model.ancestors[i]]]
        off = m.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY
        top = {b: min(model.body_dofs[b]) for b in self.bodies}
        rows = sorted(self.dynamics.recorded)
        return [
            ints("level_first", np.cumsum([0, *count])),
            ints("level_body", order),
            ints("moving_above", [self._row.get(int(m.body_parentid[b]), -1) for b in self.bodies]),
            ints("moving_top", [model.dof_top[top[b]] for b in self.bodies]),
            floats("moving_at", [at for _, at in places]),
            floats("moving_turn", [turn for turn, _ in places]),
            ints("moving_joint", [m.body_jntadr[b] for b in self.bodies]),
            ints("moving_joints", [m.body_jntnum[b] for b in self.bodies]),
            floats("moving_lift", [m.body_gravcomp[b] for b in self.bodies]),
            floats("moving_mass", self._mass),
            ints("moving_mass_at", self._mass_at),
            floats("gravity", np.zeros(3) if off else m.opt.gravity),
            ints("joint_kind", [m.jnt_type[j] for j in joints]),
            ints("joint_q", [m.jnt_qposadr[j] for j in joints]),
            ints("joint_dof", [m.jnt_dofadr[j] for j in joints]),
            floats("joint_at", m.jnt_pos),
            floats("joint_axis", m.jnt_axis),
            floats("joint_zero", [m.qpos0[m.jnt_qposadr[j]] for j in joints]),
            ints("dof_body", dof_body),
            floats("dof_armature", m.dof_armature),
            ints("entry_row", [i for i, _ in entries], "short"),
            ints("entry_column", [j for _, j in entries], "short"),
            ints("entry_place", [packed(i, j) for i, j in entries], "short"),
            ints("moving_geom", self._geoms),
            ints("moving_geom_body", [self._row[int(m.geom_bodyid[g])] for g in self._geoms]),
            floats("moving_geom_at", m.geom_pos[self._geoms]),
            floats("moving_geom_turn", [rotation(m.geom_quat[g]) for g in self._geoms]),
            ints("kept_row", [rows.index(b) for b in self._kept]),
            ints("kept_body", [self._row[b] for b in self._kept]),
        ]

    def _place(self, body: int) -> tuple[np.ndarray, np.ndarray]:
        """Rotation and position of a body before its joints, in what moves above it or in the world."""
        m = self.mj
        turn, at = rotation(m.body_quat[body]), m.body_pos[body].copy()
        above = int(m.body_parentid[body])
        while above and above not in self._row:
            own = rotation(m.body_quat[above])
            turn, at = own @ turn, m.body_pos[above] + own @ at
            above = int(m.body_parentid[above])
        return turn, at

    @property
    def _constants(self) -> list[list[np.ndarray]]:
        """Mass, centre and inertia about it (xx, yy, zz, xy, xz, yz) of each body, in its frame; ``[W]`` or ``[1]``."""
        m, masses, principal = self.mj, self.model.array("body_mass"), self.model.array("body_inertia")
        out = []
        for b in self.bodies:
            turn = rotation(m.body_iquat[b])
            tensor = np.einsum("ik,wk,jk->wij", turn, principal[:, b], turn)
            tensor[np.abs(tensor) < 1e-9 * np.abs(tensor).max()] = 0.0
            about = [tensor[:, i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
            out.append([masses[:, b], *(m.body_ipos[b, k : k + 1] for k in range(3)), *about])
        return out

    @property
    def _mass(self) -> list[list[float]]:
        return [[float(values[0]) for values in row] for row in self._constants]

    @property
    def _mass_at(self) -> np.ndarray:
        """Columns of what differs between worlds, else -1."""
        return np.array([[self.model.columns.index(values) for values in row] for row in self._constants])
