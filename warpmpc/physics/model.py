# SPDX-License-Identifier: Apache-2.0
"""Numbers of a MuJoCo model for the engine ``fused``: constants, and columns of what differs between worlds."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from .base import BOX, CAPSULE, CYLINDER, ELLIPSOID, HFIELD, HINGE, MESH, PLANE, SLIDE, SPHERE, Structure
from .coefficients import LEAST, Rows, bounds, mixed, narrow
from .collisions import colliding_pairs, seen_geoms
from .equalities import Constraint, find_constraints
from .mobility import LEVER, Mobility, floor

if TYPE_CHECKING:
    from collections.abc import Sequence

LEAST_TOLERANCE = 1e-6
"""Of the solver: single precision has no more."""
FEW_ITERATIONS, FEW_SEARCHES = 10, 20
"""Below so many iterations, or steps of a line search, the solver goes MuJoCo's way, step for step, since it may end
before the minimum."""
HARD = 100.0
"""Least regularization of rows, over its floor, at which that way is still MuJoCo's."""
PINNED, LEAST_PINNED_FRICTION = 1e-2, 1e-4
"""Share of the inverse inertia of what touches that the centre of mass has, and friction, below which pyramids become
too thin: there friction is all that holds."""
LEAST_FRICTION = 1e-5
"""Bound of a contact's coefficients of friction."""
NEWTON = int(mujoco.mjtSolver.mjSOL_NEWTON)
ENOUGH = 100
"""Iterations that Newton's method has at least where it stands in for a solver that needs many more of its kind."""
_FRICTIONS = [0, 0, 1, 2, 2]
"""A geom's coefficients of friction in the order of a contact's."""


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
    slip: float
    """Damping along the rows of friction of an elliptic cone."""

    @property
    def slides(self) -> bool:
        """Return whether there is friction."""
        return self.condim > 1


class PhysicsModel(Structure):
    """A compiled MuJoCo model as rollouts read it.

    Args:
        model: The model.
        arrays: Its arrays that differ between worlds, ``[W, ...]`` each (``randomize.batched_arrays``).
    """

    @cached_property
    def limited(self) -> list[int]:
        """Slides and hinges with limits, but for those where both may hold at once."""
        if self.off("LIMIT") or self.off("CONSTRAINT"):
            return []
        scalar = np.isin(self.mj.jnt_type, (SLIDE, HINGE))
        limited = np.flatnonzero((self.mj.jnt_limited != 0) & scalar)
        ranges, margins = self.mj.jnt_range, self.mj.jnt_margin
        return [int(j) for j in limited if bounds(ranges[j]) and not narrow(ranges[j], margins[j])]

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
    def constraints(self) -> list[Constraint]:
        """Rows of constraints between known degrees of freedom, but for limits of slides and hinges."""
        return find_constraints(self)

    def impedances(self, rows: Sequence[Rows]) -> list[tuple[float, ...]]:
        """Numbers of impedances that the source needs: powers only where one is not 2."""
        return [row.powered if self.powers else row.impedance for row in rows]

    @cached_property
    def powers(self) -> bool:
        """Return whether any impedance has a power other than 2."""
        rows = [*self.limits, *(one.rows for one in (*self.pairs, *self.constraints))]
        return any(row.power != 2.0 for row in rows)

    @cached_property
    def pairs(self) -> list[PairRow]:
        """All pairs of geoms that may touch, by their kinds."""
        m = self.mj
        if self.off("CONTACT") or self.off("CONSTRAINT"):
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
            "PAIR_FLOOR": self._pair_floors,
            "LIMIT_INVERSE": np.array([inverse[m.jnt_dofadr[j]] for j in self.limited]),
            "CONSTRAINT_INVERSE": np.array([values[0] for one in self.constraints for values in one.inverse]),
            "CONSTRAINT_FLOOR": np.array([x for one in self.constraints for x in one.floors(self.mobility)]),
            "DRY_INVERSE": inverse[self.dry],
            "TOLERANCE": np.array([2.0 * tolerance * float(m.stat.meaninertia) * max(1, m.nv)]),
            "POSE": np.hstack([data.geom_xpos, data.geom_xmat])[self.standing],
            **self._heights,
        }

    @property
    def _pair_floors(self) -> np.ndarray:
        """Least regularization of each pair, by how light its normal is, and its tangents where it slides."""
        out = []
        for pair in self.pairs:
            centre = self._centre(pair)
            light = sum(self.mobility.geom(g) for g in pair.geoms)
            if not pair.slides:
                light = 0.0 if centre > LEVER * light else light
            elif self.elliptic:
                light *= max(1.0, float(self.mj.opt.impratio))
            else:
                light *= min(1.0, float(pair.friction[:, 0].min()) ** 2)
            out.append(floor(light, centre))
        return np.array(out)

    @property
    def hard(self) -> bool:
        """Return whether a pair is nearly as hard as single precision can have it."""
        pairs = zip(self.pairs, self._pair_floors, strict=True)
        return any(p.inverse.min() * p.rows.least_share < HARD * least for p, least in pairs if least > LEAST)

    @property
    def pinned(self) -> bool:
        """Return whether pyramids without friction stand on bodies that turn about their centre of mass."""
        return not self.elliptic and any(
            pair.slides
            and pair.friction[:, 0].min() < LEAST_PINNED_FRICTION
            and self._centre(pair) < PINNED * sum(self.mobility.geom(g) for g in pair.geoms)
            for pair in self.pairs
        )

    def _centre(self, pair: PairRow) -> float:
        """Inverse inertia of both bodies' centres of mass, as a trace [1/kg]."""
        return 3.0 * float(self.mj.body_invweight0[self.mj.geom_bodyid[list(pair.geoms)], 0].sum())

    @property
    def few(self) -> bool:
        """Return whether the solver may end before the minimum, for want of iterations."""
        return self.iterations[0] < FEW_ITERATIONS or self.iterations[1] < FEW_SEARCHES

    @cached_property
    def mobility(self) -> Mobility:
        """Inverse inertias of points, where the model starts."""
        return Mobility(self.mj)

    @cached_property
    def given(self) -> np.ndarray:
        """The same, one after the other."""
        return np.concatenate([np.ravel(values) for values in self._given.values()])

    @cached_property
    def given_at(self) -> dict[str, int]:
        """Index at which each of them begins."""
        sizes = [np.size(values) for values in self._given.values()]
        return dict(zip(self._given, np.cumsum([0, *sizes]).tolist(), strict=False))

    @cached_property
    def fields(self) -> dict[int, int]:
        """Geoms that are heightfields and may touch something or be seen: where the heights of each begin."""
        m, out, first = self.mj, {}, 0
        used = {g for pair in self.pairs for g in pair.geoms} | seen_geoms(m)
        for g in sorted(g for g in used if m.geom_type[g] == HFIELD):
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
        """Return whether cones of friction are elliptic."""
        return bool(self.mj.opt.cone) and any(pair.slides for pair in self.pairs)

    @cached_property
    def frictions(self) -> int:
        """Numbers that say how a contact slides: one where both tangents are alike and all, in pyramids."""
        most = max((pair.condim for pair in self.pairs), default=1)
        alike = all((pair.friction[:, 0] == pair.friction[:, 1]).all() for pair in self.pairs)
        return most - 1 if self.elliptic or most > 3 or not alike else 1

    @property
    def iterations(self) -> tuple[int, int]:
        """Most iterations of the solver, and of its line search."""
        given = int(self.mj.opt.iterations), int(self.mj.opt.ls_iterations)
        return given if self.mj.opt.solver == NEWTON else (max(given[0], ENOUGH), max(given[1], ENOUGH))

    @property
    def slips(self) -> bool:
        """Return whether friction has references that are not those of the normal rows."""
        return any(pair.slip != pair.rows.damping for pair in self.pairs)

    def _pair(self, a: int, b: int, told: int | None) -> PairRow:
        """Parameters of two geoms: those of an explicit pair, or mixed ones (MuJoCo, "Contact parameters")."""
        m, friction = self.mj, self.array("geom_friction")
        margin = float(m.geom_margin[a] + m.geom_margin[b]) if told is None else float(m.pair_margin[told])
        if told is not None:
            condim, solref, solimp = m.pair_dim[told], m.pair_solref[told], m.pair_solimp[told]
            mu = self.array("pair_friction")[:, told]
        elif m.geom_priority[a] != m.geom_priority[b]:
            g = a if m.geom_priority[a] > m.geom_priority[b] else b
            condim, solref, solimp = m.geom_condim[g], m.geom_solref[g], m.geom_solimp[g]
            mu = friction[:, g][:, _FRICTIONS]
        else:
            weights = [w if w >= LEAST else 0.0 for w in (m.geom_solmix[a], m.geom_solmix[b])]
            mix = weights[0] / sum(weights) if any(weights) else 0.5
            condim = max(m.geom_condim[a], m.geom_condim[b])
            mu = np.maximum(friction[:, a], friction[:, b])[:, _FRICTIONS]
            both = m.geom_solref[a], m.geom_solref[b]
            direct = both[0][0] <= 0.0 or both[1][0] <= 0.0
            solref = np.minimum(*both) if direct else mix * both[0] + (1.0 - mix) * both[1]
            solimp = mix * m.geom_solimp[a] + (1.0 - mix) * m.geom_solimp[b]
        if m.opt.enableflags & int(mujoco.mjtEnableBit.mjENBL_OVERRIDE):
            margin, solref, solimp, mu = float(m.opt.o_margin), m.opt.o_solref, m.opt.o_solimp, m.opt.o_friction[None]
        bodies = int(m.geom_bodyid[a]), int(m.geom_bodyid[b])
        weight = self.array("body_invweight0")
        inverse = weight[:, bodies[0], 0] + weight[:, bodies[1], 0]
        mu = np.maximum(mu, LEAST_FRICTION)
        if condim > 1 and not m.opt.cone:  # of the edges of a pyramid, all regularized alike
            inverse = 2.0 * mu[:, 0] ** 2 / float(m.opt.impratio) * (1.0 + mu[:, 0] ** 2) * inverse
        chains = self.body_dofs[bodies[0]], self.body_dofs[bodies[1]]
        dofs = tuple(sorted(chains[0] ^ chains[1]))
        signs = tuple(1.0 if dof in chains[1] else -1.0 for dof in dofs)
        rows = self.rows(solref, solimp)
        slip = rows.damping
        if told is not None and m.opt.cone and not m.opt.enableflags & int(mujoco.mjtEnableBit.mjENBL_OVERRIDE):
            own = m.pair_solreffriction[told]
            slip = self.rows(own, solimp).damping if own.any() and not mixed(own) else slip
        return PairRow((a, b), rows, margin, int(condim), mu, inverse, dofs, signs, slip)


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
