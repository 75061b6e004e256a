# SPDX-License-Identifier: Apache-2.0
"""Tables of the moving bodies and their joints for the lanes of a warp (``native/links.h``).

What :mod:`.tree` writes out as straight-line code, which suits one thread with many worlds, all lanes of a warp would
do alike; here each takes a body, an axis or an entry of the mass matrix.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from .base import BALL, FREE, HINGE, SLIDE, packed, rotation
from .source_parts import floats, ints

if TYPE_CHECKING:
    from .dynamics import Dynamics


class Links:
    """Sizes and tables of the moving bodies of a model.

    Args:
        dynamics: Says which geoms and bodies are wanted.
    """

    def __init__(self, dynamics: Dynamics):
        self.dynamics, self.model, self.mj = dynamics, dynamics.model, dynamics.mj
        self.bodies = [b for b in range(1, self.mj.nbody) if self.model.moves(b)]
        """In MuJoCo's order: what hangs on a body follows it."""
        self._row = {b: n for n, b in enumerate(self.bodies)}
        self._links = [(b, j) for b in self.bodies for j in self._joints(b) or [-1]]
        """Body and joint of each link; a body without joints is one."""
        last = {b: n for n, (b, _) in enumerate(self._links)}
        self._last = [last[b] for b in self.bodies]
        self._of_joint = {j: n for n, (_, j) in enumerate(self._links) if j >= 0}
        used = [g for g in range(self.mj.ngeom) if g in dynamics.bodies.used and g not in self.model.standing]
        self._geoms = [g for g in used if int(self.mj.geom_bodyid[g]) in self._row]
        self._kept = [b for b in sorted(dynamics.bodies.recorded) if b in self._row]

    @property
    def sizes(self) -> dict[str, int]:
        """Macros of the source."""
        nv = self.mj.nv
        return {
            "MOVING": max(1, len(self.bodies)),
            "LINKS": max(1, len(self._links)),
            "ROUNDS": len(self._above),
            "MOVING_GEOMS": len(self._geoms),
            "KEPT": len(self._kept),
            "SITES": len(self.dynamics.sites.all),
            "MOVING_MARKS": len(self._sites),
            "ENTRIES": sum(1 + len(self.model.ancestors[i]) for i in range(nv)),
            "MASSES_VARY": int((self._mass_at >= 0).any()),
        }

    def tables(self) -> list[str]:
        """Definitions of the tables, for a warp alone."""
        m, model = self.mj, self.model
        places = [self._place(*link) for link in self._links]
        joints = range(m.njnt)
        dof_body = [self._row[int(b)] for b in m.dof_bodyid]
        entries = [(i, j) for i in range(m.nv) for j in [i, *model.ancestors[i]]]
        top = {b: min(model.body_dofs[b]) for b in self.bodies}
        rows = sorted(self.dynamics.bodies.recorded)
        sites = [self.dynamics.sites.all[n] for n in self._sites]
        return [
            floats("link_at", [at for _, at in places]),
            floats("link_turn", [turn for turn, _ in places]),
            ints("link_joint", [j for _, j in self._links]),
            ints("link_above", self._above),
            ints("moving_link", self._last),
            ints("moving_above", [self._row.get(int(m.body_parentid[b]), -1) for b in self.bodies]),
            ints("moving_top", [model.dof_top[top[b]] for b in self.bodies]),
            *self._lists("before", [self._before(i) for i in range(m.nv)]),
            *self._lists("chain", [sorted(model.body_dofs[b]) for b in self.bodies]),
            *self._axes(),
            floats("moving_lift", [model.lift(b) for b in self.bodies]),
            floats("moving_mass", self._mass),
            ints("moving_mass_at", self._mass_at),
            floats("gravity", [x if isinstance(x, float) else 0.0 for x in model.gravity]),
            ints("joint_kind", [m.jnt_type[j] for j in joints]),
            ints("joint_q", [m.jnt_qposadr[j] for j in joints]),
            ints("joint_dof", [m.jnt_dofadr[j] for j in joints]),
            floats("joint_at", m.jnt_pos),
            floats("joint_axis", m.jnt_axis),
            floats("joint_zero", [m.qpos0[m.jnt_qposadr[j]] for j in joints]),
            ints("dof_body", dof_body),
            floats("entry_armature", [self._armature(i, j) for i, j in entries]),
            ints("entry_row", [i for i, _ in entries], "short"),
            ints("entry_column", [j for _, j in entries], "short"),
            ints("entry_place", [packed(i, j) for i, j in entries], "short"),
            ints("moving_geom", self._geoms),
            ints("moving_geom_body", [self._row[int(m.geom_bodyid[g])] for g in self._geoms]),
            floats("moving_geom_at", m.geom_pos[self._geoms]),
            floats("moving_geom_turn", [rotation(m.geom_quat[g]) for g in self._geoms]),
            ints("moving_mark", self._sites),
            ints("moving_mark_body", [self._row[site.body] for site in sites]),
            floats("moving_mark_at", [site.at for site in sites]),
            floats("moving_mark_turn", [site.turn for site in sites]),
            ints("kept_row", [rows.index(b) for b in self._kept]),
            ints("kept_body", [self._row[b] for b in self._kept]),
        ]

    @property
    def _sites(self) -> list[int]:
        """Sites on bodies that move."""
        return [n for n, site in enumerate(self.dynamics.sites.all) if site.body in self._row]

    def _armature(self, i: int, j: int) -> float:
        """Contribution of armatures to an entry of the mass matrix."""
        return (float(self.model.armatures[i]) if i == j else 0.0) + self.model.tendon_armatures.get((i, j), 0.0)

    def _joints(self, body: int) -> list[int]:
        first = int(self.mj.body_jntadr[body])
        return list(range(first, first + int(self.mj.body_jntnum[body])))

    @cached_property
    def _above(self) -> list[list[int]]:
        """For each round the link that each one joins then, -1 where it has reached the world."""
        parent = self.mj.body_parentid
        row = []
        for n, (b, _) in enumerate(self._links):
            before = n - 1 if n and self._links[n - 1][0] == b else self._row.get(int(parent[b]))
            first = n and self._links[n - 1][0] == b
            row.append(-1 if before is None else before if first else self._last[before])
        rounds = []
        while any(above >= 0 for above in row):
            rounds.append(row)
            row = [-1 if above < 0 else row[above] for above in row]
        return rounds

    def _before(self, dof: int) -> list[int]:
        """Degrees of freedom whose motion a joint's rotation or slide is carried along by."""
        m, above = self.mj, self.model.ancestors[dof]
        if m.jnt_type[m.dof_jntid[dof]] not in (FREE, BALL):
            return above
        first = int(m.jnt_dofadr[m.dof_jntid[dof]])  # three axes turn as one
        turning = first + 3 if m.jnt_type[m.dof_jntid[dof]] == FREE else first
        return [i for i in above if i < (turning if dof >= turning else first)]

    def _lists(self, name: str, rows: list[list[int]]) -> list[str]:
        flat = [i for row in rows for i in row]
        return [
            ints(f"{name}_first", np.cumsum([0, *(len(row) for row in rows)])),
            ints(f"{name}_dof", flat, "short"),
        ]

    def _axes(self) -> list[str]:
        """Tables of degrees of freedom: their axes, a point on them, and the point of their tree."""
        m, rows = self.mj, []
        for i in range(m.nv):
            j = int(m.dof_jntid[i])
            k, kind = i - int(m.jnt_dofadr[j]), int(m.jnt_type[j])
            axis = m.jnt_axis[j] if kind in (SLIDE, HINGE) else np.eye(3)[k % 3]
            at = m.jnt_pos[j] if kind != FREE else np.zeros(3)
            root, root_at = self._root(int(m.dof_bodyid[self.model.dof_top[i]]))
            rows.append((self._of_joint[j], axis, at, not self.model.slides(i), kind == FREE and k < 3, root, root_at))
        links, axes, at, turns, world, root, root_at = zip(*rows, strict=True) if rows else ([],) * 7
        return [
            ints("dof_link", links),
            floats("dof_axis", axes),
            floats("dof_at", at),
            ints("dof_turns", turns),
            ints("dof_world", world),
            ints("dof_root", root),
            floats("dof_root_at", root_at),
        ]

    def _root(self, body: int) -> tuple[int, np.ndarray]:
        """A link of a tree's first body, and the point on it that spatial vectors are taken about."""
        m = self.mj
        for j in self._joints(body):
            if m.jnt_type[j] != SLIDE:
                return self._of_joint[j], np.zeros(3) if m.jnt_type[j] == FREE else m.jnt_pos[j]
        return self._last[self._row[body]], np.zeros(3)

    def _place(self, body: int, joint: int) -> tuple[np.ndarray, np.ndarray]:
        """Rotation and position of a link before its joint, in the link above it or in the world."""
        m = self.mj
        if joint > m.body_jntadr[body] >= 0:
            return np.eye(3), np.zeros(3)
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
        return [[self.model.columns.constant(values) for values in row] for row in self._constants]

    @property
    def _mass_at(self) -> np.ndarray:
        """Columns of what differs between worlds, else -1."""
        return np.array([[self.model.columns.index(values) for values in row] for row in self._constants])
