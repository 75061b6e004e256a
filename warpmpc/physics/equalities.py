# SPDX-License-Identifier: Apache-2.0
"""Constraints between degrees of freedom that are known beforehand, row by row.

These are equalities, limits of ball joints and tendons, friction of tendons. What is baked here gives their Jacobians
and distances; ``native/constraints.h`` softens them and takes them into the solver, contacts beside them come and go.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from .base import HINGE, SLIDE
from .coefficients import LEAST, UNBOUNDED, Rows, bounds, narrow
from .mobility import floor

if TYPE_CHECKING:
    from .base import Structure
    from .mobility import Mobility

CONNECT, WELD, JOINT, TENDON = (
    int(kind)
    for kind in (
        mujoco.mjtEq.mjEQ_CONNECT,
        mujoco.mjtEq.mjEQ_WELD,
        mujoco.mjtEq.mjEQ_JOINT,
        mujoco.mjtEq.mjEQ_TENDON,
    )
)
FREELY = 3e38
"""A force without bound."""


@dataclass(frozen=True)
class Constraint:
    """One row, or several of the same degrees of freedom that are softened together."""

    kind: str
    """``equality``, ``ball`` (limit), ``limit`` or ``friction`` (of a tendon), ``narrow`` (limits of a joint)."""
    index: int
    """Of the equality, joint or tendon."""
    dofs: tuple[int, ...]
    rows: Rows
    inverse: tuple[np.ndarray, ...]
    """Approximate inverse inertia along each row ``[W]`` or ``[1]``."""
    low: float = -FREELY
    """Least derivative of the cost by the row, which is the force with the other sign [N]."""
    high: float = FREELY
    """The largest."""
    sides: tuple[float, ...] = (1.0, -1.0)
    """Which limits of a range are meant: the lower, the upper, or the nearer of both."""
    points: tuple[tuple[int, np.ndarray], ...] = ()
    """Bodies that are connected or welded, and where, in their frames."""

    def floors(self, mobility: Mobility) -> list[float]:
        """Least regularization of each row."""
        if not self.points:
            return [LEAST] * len(self.inverse)
        moved = floor(*(mobility.point(body, mobility.place(body, at)) for body, at in self.points))
        turned = floor(*(mobility.turn(body) for body, _ in self.points))
        return ([moved] * 3 + [turned] * 3)[: len(self.inverse)]


def find_constraints(model: Structure) -> list[Constraint]:
    """All constraints of a model."""
    m, out = model.mj, []
    if model.off("CONSTRAINT"):
        return []
    for e in np.flatnonzero(m.eq_active0[: m.neq]) if not model.off("EQUALITY") else ():
        out.append(_equality(model, int(e)))
    limited, frictional = not model.off("LIMIT"), not model.off("FRICTIONLOSS")
    balls = (m.jnt_type == int(mujoco.mjtJoint.mjJNT_BALL)) & (m.jnt_limited != 0)
    for j in np.flatnonzero(balls & (m.jnt_range.max(axis=1) < UNBOUNDED)) if limited else ():
        dof = int(m.jnt_dofadr[j])
        rows = model.rows(m.jnt_solref[j], m.jnt_solimp[j])
        inverse = model.array("dof_invweight0")[:, dof]
        out.append(Constraint("ball", int(j), (dof, dof + 1, dof + 2), rows, (inverse,), high=0.0))
    for t in range(m.ntendon):
        dofs, inverse = model.tendon_dofs[t], model.array("tendon_invweight0")[:, t]
        loss = float(m.tendon_frictionloss[t])
        if loss > 0.0 and frictional:
            rows = model.rows(m.tendon_solref_fri[t], m.tendon_solimp_fri[t]).slipping
            out.append(Constraint("friction", t, dofs, rows, (inverse,), -loss, loss))
        if m.tendon_limited[t] and limited and bounds(m.tendon_range[t]):
            rows = model.rows(m.tendon_solref_lim[t], m.tendon_solimp_lim[t])
            out += _limits(
                Constraint("limit", t, dofs, rows, (inverse,), high=0.0), m.tendon_range[t], m.tendon_margin[t]
            )
    scalar = np.isin(m.jnt_type, (SLIDE, HINGE)) & (m.jnt_limited != 0)
    for j in np.flatnonzero(scalar) if limited else ():
        if bounds(m.jnt_range[j]) and narrow(m.jnt_range[j], m.jnt_margin[j]):
            dof, rows = int(m.jnt_dofadr[j]), model.rows(m.jnt_solref[j], m.jnt_solimp[j])
            one = Constraint("narrow", int(j), (dof,), rows, (model.array("dof_invweight0")[:, dof],), high=0.0)
            out += _limits(one, m.jnt_range[j], m.jnt_margin[j])
    return out


def _limits(constraint: Constraint, limits: np.ndarray, margin: float) -> list[Constraint]:
    """One row for the nearer of two limits, or two where both may hold at once."""
    if not narrow(limits, margin):
        return [constraint]
    return [replace(constraint, sides=(side,)) for side in (1.0, -1.0)]


def ends(m: mujoco.MjModel, e: int) -> tuple[int, int]:
    """Bodies of a connect or weld."""
    pair = int(m.eq_obj1id[e]), int(m.eq_obj2id[e])
    if int(m.eq_objtype[e]) == int(mujoco.mjtObj.mjOBJ_SITE):
        return int(m.site_bodyid[pair[0]]), int(m.site_bodyid[pair[1]])
    return pair


def _equality(model: Structure, e: int) -> Constraint:
    m, kind = model.mj, int(model.mj.eq_type[e])
    rows = model.rows(m.eq_solref[e], m.eq_solimp[e])
    first, second = int(m.eq_obj1id[e]), int(m.eq_obj2id[e])
    if kind == JOINT:
        dofs = tuple(int(m.jnt_dofadr[j]) for j in (first, second) if j >= 0)
        weights = model.array("dof_invweight0")
        return Constraint("equality", e, dofs, rows, (sum(weights[:, dof] for dof in dofs),))
    if kind == TENDON:
        tendons = [t for t in (first, second) if t >= 0]
        dofs = tuple(sorted({dof for t in tendons for dof in model.tendon_dofs[t]}))
        weights = model.array("tendon_invweight0")
        return Constraint("equality", e, dofs, rows, (sum(weights[:, t] for t in tendons),))
    bodies, weights = ends(m, e), model.array("body_invweight0")
    dofs = tuple(sorted(model.body_dofs[bodies[0]] | model.body_dofs[bodies[1]]))
    moved, turned = (weights[:, bodies[0], k] + weights[:, bodies[1], k] for k in (0, 1))
    if int(m.eq_objtype[e]) == int(mujoco.mjtObj.mjOBJ_SITE):
        at = m.site_pos[[first, second]]
    else:
        at = m.eq_data[e, :6].reshape(2, 3)[:: 1 if kind == CONNECT else -1]
    inverse = (moved,) * 3 if kind == CONNECT else (moved,) * 3 + (turned,) * 3
    return Constraint("equality", e, dofs, rows, inverse, points=tuple(zip(bodies, at, strict=True)))
