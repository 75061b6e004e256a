# SPDX-License-Identifier: Apache-2.0
"""What the engine ``fused`` takes from a MuJoCo model: constants, and columns of what differs between worlds."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from ...bake.lines import Operand
from ...model.collisions import colliding_pairs
from .limits import bounds
from .rows import Rows
from .tendons import tendon_armatures, tendon_dofs
from .ties import Tie, find_ties

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

GEOM, JOINT = mujoco.mjtGeom, mujoco.mjtJoint
PLANE, HFIELD, SPHERE, CAPSULE, CYLINDER, BOX, ELLIPSOID, MESH = (
    int(kind)
    for kind in (
        GEOM.mjGEOM_PLANE,
        GEOM.mjGEOM_HFIELD,
        GEOM.mjGEOM_SPHERE,
        GEOM.mjGEOM_CAPSULE,
        GEOM.mjGEOM_CYLINDER,
        GEOM.mjGEOM_BOX,
        GEOM.mjGEOM_ELLIPSOID,
        GEOM.mjGEOM_MESH,
    )
)
FREE, BALL, SLIDE, HINGE = (
    int(kind) for kind in (JOINT.mjJNT_FREE, JOINT.mjJNT_BALL, JOINT.mjJNT_SLIDE, JOINT.mjJNT_HINGE)
)
LEAST_TOLERANCE = 1e-6
"""Of the solver: single precision has no more."""
MOST_POWER = 16
"""Of an impedance."""
LEAST_FRICTION = 1e-5
"""Bound of a contact's coefficients of friction."""
_FRICTIONS = [0, 0, 1, 2, 2]
"""A geom's coefficients of friction in the order of a contact's."""


def rotation(quaternion: np.ndarray) -> np.ndarray:
    """The matrix ``[3, 3]`` of a quaternion (w, x, y, z)."""
    out = np.empty(9)
    mujoco.mju_quat2Mat(out, np.asarray(quaternion, dtype=float))
    return out.reshape(3, 3)


class Columns:
    """Numbers of a model: known ones as they are, those that differ between worlds as names of columns.

    Args:
        arrays: Arrays of the model that differ between worlds, ``[W, ...]`` each.
    """

    def __init__(self, arrays: Mapping[str, np.ndarray]):
        self.arrays = dict(arrays)
        self.values: list[np.ndarray] = []
        """What the columns hold, ``[W]`` each."""

    def index(self, values: np.ndarray) -> int:
        """Column of some values ``[W]``, -1 where all are alike."""
        if np.ptp(values) == 0.0:
            return -1
        for i, column in enumerate(self.values):
            if np.array_equal(column, values):
                return i
        self.values.append(values)
        return len(self.values) - 1

    def operand(self, values: np.ndarray) -> Operand:
        """Values of all worlds ``[W]``, or of one ``[1]``, as an operand of baked source."""
        column = self.index(values)
        return float(values[0]) if column < 0 else f"w.par[{column}]"


@dataclass(frozen=True)
class PairRow:
    """Two geoms that may touch."""

    geoms: tuple[int, int]
    """By type, as MuJoCo orders them."""
    rows: Rows
    margin: float
    condim: int
    """Its rows: 1 without friction, 3 with friction along the tangents, 4 also about the normal, 6 also about these."""
    friction: np.ndarray
    """Along both tangents, about the normal and about both tangents, of all worlds ``[W, 5]`` or one ``[1, 5]``."""
    inverse: np.ndarray
    """Approximate inverse inertia along a row, as MuJoCo regularizes it ``[W]`` or ``[1]``."""
    dofs: tuple[int, ...]
    """Degrees of freedom that move one geom and not the other."""
    signs: tuple[float, ...]
    """1 for those that move the second."""

    @property
    def slides(self) -> bool:
        """Whether there is friction."""
        return self.condim > 1


class PhysicsModel:
    """A compiled MuJoCo model as the engine reads it.

    Args:
        model: The model.
        arrays: Its arrays that differ between worlds, ``[W, ...]`` each (``randomize.batched_arrays``).
    """

    def __init__(self, model: mujoco.MjModel, arrays: Mapping[str, np.ndarray] | None = None):
        self.mj, self.columns = model, Columns(arrays or {})

    def off(self, part: str) -> bool:
        """Whether a flag of the options disables a part of the physics, ``SPRING`` for example."""
        flag = getattr(mujoco.mjtDisableBit, f"mjDSBL_{part}")
        return bool(self.mj.opt.disableflags & flag)

    @property
    def passive(self) -> bool:
        """Whether there are passive forces: without springs and dampers MuJoCo has no others of them either."""
        return not (self.off("SPRING") and self.off("DAMPER"))

    def lift(self, body: int) -> float:
        """Share of a body's weight that is compensated."""
        return float(self.mj.body_gravcomp[body]) if self.passive else 0.0

    def array(self, name: str) -> np.ndarray:
        """An array of the model with a first axis for worlds, of length 1 where all are alike."""
        found = self.columns.arrays.get(name)
        return getattr(self.mj, name)[None] if found is None else found

    @cached_property
    def ancestors(self) -> list[list[int]]:
        """Degrees of freedom above each, from the nearest on."""
        parent, out = self.mj.dof_parentid, []
        for i in range(self.mj.nv):
            chain, j = [], int(parent[i])
            while j >= 0:
                chain.append(j)
                j = int(parent[j])
            out.append(chain)
        return out

    @cached_property
    def dof_top(self) -> list[int]:
        """First degree of freedom of each one's tree."""
        return [(chain or [i])[-1] for i, chain in enumerate(self.ancestors)]

    @cached_property
    def body_dofs(self) -> list[frozenset[int]]:
        """Degrees of freedom that move each body."""
        m, out = self.mj, []
        for body in range(m.nbody):
            first, count = int(m.body_dofadr[body]), int(m.body_dofnum[body])
            above = out[m.body_parentid[body]] if body else frozenset()
            out.append(above | frozenset(range(first, first + count)))
        return out

    def moves(self, body: int) -> bool:
        """Whether joints move a body."""
        return bool(self.body_dofs[body])

    @cached_property
    def dof_coordinate(self) -> list[int]:
        """Coordinate of the degrees of freedom of slides and hinges, -1 for others."""
        m, out = self.mj, [-1] * self.mj.nv
        for j in range(m.njnt):
            if m.jnt_type[j] in (SLIDE, HINGE):
                out[m.jnt_dofadr[j]] = int(m.jnt_qposadr[j])
        return out

    def rigid(self, root: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mass, mass times centre and inertia of a body with all that is welded to it, about its origin in its frame.

        Args:
            root: The body.

        Returns:
            ``[W]``, ``[W, 3]`` and ``[W, 3, 3]``, with one row where all worlds are alike.
        """
        m = self.mj
        masses, principal = self.array("body_mass"), self.array("body_inertia")
        poses = {root: (np.eye(3), np.zeros(3))}
        for body in range(root + 1, m.nbody):
            above = poses.get(int(m.body_parentid[body]))
            if above is not None:
                turn, at = above
                poses[body] = turn @ rotation(m.body_quat[body]), at + turn @ m.body_pos[body]
        mass, moment, inertia = np.zeros(1), np.zeros((1, 3)), np.zeros((1, 3, 3))
        for body, (turn, at) in poses.items():
            axes, centre = turn @ rotation(m.body_iquat[body]), at + turn @ m.body_ipos[body]
            own = np.einsum("ik,wk,jk->wij", axes, principal[:, body], axes)
            away = centre @ centre * np.eye(3) - np.outer(centre, centre)
            mass = mass + masses[:, body]
            moment = moment + masses[:, body, None] * centre
            inertia = inertia + own + masses[:, body, None, None] * away
        return mass, moment, inertia

    @cached_property
    def limited(self) -> list[int]:
        """Slides and hinges with a limit."""
        if self.off("LIMIT") or self.off("CONSTRAINT"):
            return []
        scalar = np.isin(self.mj.jnt_type, (SLIDE, HINGE))
        limited = np.flatnonzero((self.mj.jnt_limited != 0) & scalar)
        return [int(j) for j in limited if bounds(self.mj.jnt_range[j])]

    @cached_property
    def limits(self) -> list[Rows]:
        """Parameters of these limits."""
        return [self.rows(self.mj.jnt_solref[j], self.mj.jnt_solimp[j]) for j in self.limited]

    @cached_property
    def dry(self) -> list[int]:
        """Degrees of freedom with friction of their own."""
        if self.off("FRICTIONLOSS") or self.off("CONSTRAINT"):
            return []
        return [int(i) for i in np.flatnonzero(self.mj.dof_frictionloss > 0.0)]

    @cached_property
    def ties(self) -> list[Tie]:
        """Rows of constraints between known degrees of freedom, but for limits of slides and hinges."""
        return find_ties(self)

    @cached_property
    def tendon_dofs(self) -> list[tuple[int, ...]]:
        """Degrees of freedom that change the length of each tendon."""
        return tendon_dofs(self)

    @cached_property
    def tendon_armatures(self) -> dict[tuple[int, int], float]:
        """What armatures of tendons add to entries of the mass matrix."""
        return tendon_armatures(self)

    def slides(self, dof: int) -> bool:
        """Whether a degree of freedom turns nothing."""
        m, joint = self.mj, int(self.mj.dof_jntid[dof])
        kind = int(m.jnt_type[joint])
        return kind == SLIDE or (kind == FREE and dof < int(m.jnt_dofadr[joint]) + 3)

    def rows(self, solref: np.ndarray, solimp: np.ndarray) -> Rows:
        """Soft constraint parameters with this model's options."""
        option = self.mj.opt
        safe = not option.disableflags & mujoco.mjtDisableBit.mjDSBL_REFSAFE
        return Rows.of(solref, solimp, float(option.timestep), safe=bool(safe))

    def impedances(self, rows: Sequence[Rows]) -> list[tuple[float, ...]]:
        """What the source needs of impedances: powers only where one is not 2."""
        return [row.powered if self.powers else row.impedance for row in rows]

    @cached_property
    def powers(self) -> bool:
        """Whether any impedance has a power other than 2."""
        rows = [*self.limits, *(pair.rows for pair in self.pairs), *(tie.rows for tie in self.ties)]
        return any(row.power != 2.0 for row in rows)

    @cached_property
    def pairs(self) -> list[PairRow]:
        """All pairs of geoms that may touch, by their kinds."""
        m = self.mj
        if m.opt.disableflags & (mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT):
            return []
        out = []
        told = {tuple(sorted((int(m.pair_geom1[p]), int(m.pair_geom2[p])))): p for p in range(m.npair)}
        met = {(int(a), int(b)) for a, b in np.argwhere(np.triu(colliding_pairs(m), 1))}
        for a, b in sorted(met | set(told)):
            first, second = (a, b) if m.geom_type[a] <= m.geom_type[b] else (b, a)
            if self.moves(int(m.geom_bodyid[a])) or self.moves(int(m.geom_bodyid[b])):
                out.append(self._pair(first, second, told.get((a, b))))
        return sorted(out, key=lambda pair: tuple(int(m.geom_type[g]) for g in pair.geoms))

    @cached_property
    def standing(self) -> list[int]:
        """Geoms that neither joints nor mocap bodies move."""
        m = self.mj
        rooted = [int(m.body_mocapid[m.body_rootid[m.geom_bodyid[g]]]) for g in range(m.ngeom)]
        return [g for g in range(m.ngeom) if rooted[g] < 0 and not self.moves(int(m.geom_bodyid[g]))]

    @cached_property
    def _given(self) -> dict[str, np.ndarray]:
        """Numbers that are no part of the source, since scenes draw them or they follow from where a scene starts."""
        m, inverse = self.mj, self.array("dof_invweight0")[0]
        data = mujoco.MjData(m)
        mujoco.mj_kinematics(m, data)
        tolerance = max(float(m.opt.tolerance), LEAST_TOLERANCE)
        return {
            "SIZE": self.array("geom_size")[0],
            "BOUND": self.array("geom_rbound").max(axis=0),
            "FRICTION": np.array([pair.friction[0, : self.frictions] for pair in self.pairs]),
            "PAIR_INVERSE": np.array([pair.inverse[0] for pair in self.pairs]),
            "LIMIT_INVERSE": np.array([inverse[m.jnt_dofadr[j]] for j in self.limited]),
            "TIE_INVERSE": np.array([values[0] for tie in self.ties for values in tie.inverse]),
            "DRY_INVERSE": inverse[self.dry],
            "TOLERANCE": np.array([2.0 * tolerance * float(m.stat.meaninertia) * max(1, m.nv)]),
            "POSE": np.hstack([data.geom_xpos, data.geom_xmat])[self.standing],
            **self._heights,
        }

    @cached_property
    def given(self) -> np.ndarray:
        """The same, one after the other."""
        return np.concatenate([np.ravel(values) for values in self._given.values()])

    @cached_property
    def given_at(self) -> dict[str, int]:
        """Where each of them begins."""
        sizes = [np.size(values) for values in self._given.values()]
        return dict(zip(self._given, np.cumsum([0, *sizes]).tolist(), strict=False))

    @cached_property
    def fields(self) -> dict[int, int]:
        """Geoms that are heightfields and may touch something: where the heights of each begin."""
        m, out, first = self.mj, {}, 0
        for g in sorted({g for pair in self.pairs for g in pair.geoms if m.geom_type[g] == HFIELD}):
            out[g] = first
            first += int(m.hfield_nrow[m.geom_dataid[g]] * m.hfield_ncol[m.geom_dataid[g]])
        return out

    @property
    def _heights(self) -> dict[str, np.ndarray]:
        m, rows = self.mj, []
        for g in self.fields:
            field = int(m.geom_dataid[g])
            first, count = int(m.hfield_adr[field]), int(m.hfield_nrow[field] * m.hfield_ncol[field])
            rows.append(m.hfield_size[field, 2] * m.hfield_data[first : first + count])
        return {"FIELD": np.concatenate(rows)} if rows else {}

    @cached_property
    def elliptic(self) -> bool:
        """Whether cones of friction are elliptic."""
        return bool(self.mj.opt.cone) and any(pair.slides for pair in self.pairs)

    @cached_property
    def frictions(self) -> int:
        """Numbers that say how a contact rubs: one where both tangents are alike and all, in pyramids."""
        most = max((pair.condim for pair in self.pairs), default=1)
        alike = all((pair.friction[:, 0] == pair.friction[:, 1]).all() for pair in self.pairs)
        return most - 1 if self.elliptic or most > 3 or not alike else 1

    def _pair(self, a: int, b: int, told: int | None) -> PairRow:
        """Parameters of two geoms: those of an explicit pair, or mixed ones (MuJoCo, "Contact parameters")."""
        m, friction = self.mj, self.array("geom_friction")
        margin = float(m.geom_margin[a] + m.geom_margin[b]) if told is None else float(m.pair_margin[told])
        if told is not None:
            condim, solref, solimp, mu = (
                m.pair_dim[told],
                m.pair_solref[told],
                m.pair_solimp[told],
                m.pair_friction[None, told],
            )
        elif m.geom_priority[a] != m.geom_priority[b]:
            g = a if m.geom_priority[a] > m.geom_priority[b] else b
            condim, solref, solimp = m.geom_condim[g], m.geom_solref[g], m.geom_solimp[g]
            mu = friction[:, g][:, _FRICTIONS]
        else:
            weights = m.geom_solmix[a], m.geom_solmix[b]
            total = sum(weights)
            mix = weights[0] / total if total > 1e-15 else 0.5
            condim = max(m.geom_condim[a], m.geom_condim[b])
            mu = np.maximum(friction[:, a], friction[:, b])[:, _FRICTIONS]
            both = m.geom_solref[a], m.geom_solref[b]
            direct = both[0][0] <= 0.0 or both[1][0] <= 0.0
            solref = np.minimum(*both) if direct else mix * both[0] + (1.0 - mix) * both[1]
            solimp = mix * m.geom_solimp[a] + (1.0 - mix) * m.geom_solimp[b]
        bodies = int(m.geom_bodyid[a]), int(m.geom_bodyid[b])
        weight = self.array("body_invweight0")
        inverse = weight[:, bodies[0], 0] + weight[:, bodies[1], 0]
        mu = np.maximum(mu, LEAST_FRICTION)
        if condim > 1 and not m.opt.cone:  # of the edges of a pyramid, all regularized alike
            inverse = 2.0 * mu[:, 0] ** 2 / float(m.opt.impratio) * (1.0 + mu[:, 0] ** 2) * inverse
        chains = self.body_dofs[bodies[0]], self.body_dofs[bodies[1]]
        dofs = tuple(sorted(chains[0] ^ chains[1]))
        signs = tuple(1.0 if dof in chains[1] else -1.0 for dof in dofs)
        return PairRow((a, b), self.rows(solref, solimp), margin, int(condim), mu, inverse, dofs, signs)


CONVEX = frozenset(
    (
        (SPHERE, ELLIPSOID),
        (CAPSULE, ELLIPSOID),
        (CAPSULE, CYLINDER),
        (ELLIPSOID, ELLIPSOID),
        (ELLIPSOID, CYLINDER),
        (ELLIPSOID, BOX),
        (CYLINDER, CYLINDER),
        (CYLINDER, BOX),
        *((kind, MESH) for kind in (PLANE, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH)),
    )
)
"""Kinds of pairs that are looked at as any convex shapes."""
FLAT = frozenset((CAPSULE, CYLINDER, BOX, MESH))
"""Shapes with faces or edges: MuJoCo may find several contacts between two of them."""
FIELD = frozenset((HFIELD, kind) for kind in (SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH))
"""Kinds of pairs with a heightfield."""
COLLIDES = (
    CONVEX
    | FIELD
    | {
        *((PLANE, kind) for kind in (SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX)),
        *((SPHERE, kind) for kind in (SPHERE, CAPSULE, CYLINDER, BOX)),
        (CAPSULE, CAPSULE),
        (CAPSULE, BOX),
        (BOX, BOX),
    }
)
"""Kinds of geoms whose contacts this engine finds."""
