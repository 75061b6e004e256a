# SPDX-License-Identifier: Apache-2.0
"""The structure of a MuJoCo model: bodies, degrees of freedom, tendons; and columns of numbers that differ by world."""

from __future__ import annotations

import logging
from functools import cached_property
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from .coefficients import REFERENCE, Rows, mixed, powers
from .runtime.bake import Matrix, Operand, Vector

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

logger = logging.getLogger("warpmpc")
GEOM, JOINT = mujoco.mjtGeom, mujoco.mjtJoint
PLANE, HFIELD, SPHERE, CAPSULE, CYLINDER, BOX, ELLIPSOID, MESH = (
    int(getattr(GEOM, f"mjGEOM_{kind}"))
    for kind in ("PLANE", "HFIELD", "SPHERE", "CAPSULE", "CYLINDER", "BOX", "ELLIPSOID", "MESH")
)
FREE, BALL, SLIDE, HINGE = (int(getattr(JOINT, f"mjJNT_{kind}")) for kind in ("FREE", "BALL", "SLIDE", "HINGE"))
WRAP_JOINT, WRAP_PULLEY, WRAP_SITE, WRAP_SPHERE, WRAP_CYLINDER = (
    int(getattr(mujoco.mjtWrap, f"mjWRAP_{kind}")) for kind in ("JOINT", "PULLEY", "SITE", "SPHERE", "CYLINDER")
)
MOST_SHARED = 64
"""Degrees of freedom of a world that fits into the memory which the lanes of a warp share."""
MOST_GROUP = 30
"""Of actuators that can be disabled."""
_ON_JOINTS = int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)
_ON_TENDONS = (int(mujoco.mjtTrn.mjTRN_TENDON),)
NOTHING: Vector = [0.0, 0.0, 0.0]
IDENTITY: Matrix = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


def packed(i: int, j: int) -> int:
    """Place of entry (i, j), j ≤ i, of a symmetric matrix that is kept by rows."""
    return i * (i + 1) // 2 + j


def rotation(quaternion: np.ndarray) -> np.ndarray:
    """The matrix ``[3, 3]`` of a quaternion (w, x, y, z)."""
    out = np.empty(9)
    mujoco.mju_quat2Mat(out, np.asarray(quaternion, dtype=float))
    return out.reshape(3, 3)


def wraps(m: mujoco.MjModel, tendon: int) -> range:
    """Wrap objects of a tendon."""
    first = int(m.tendon_adr[tendon])
    return range(first, first + int(m.tendon_num[tendon]))


class Columns:
    """Numbers of a model: known ones as they are, those that differ between worlds as names of columns.

    Args:
        arrays: Arrays of the model that differ between worlds, ``[W, ...]`` each.
        settable: Whether their numbers have columns even where all worlds are alike, unless all are zero.
        decided: :attr:`decisions` of the model whose source is to be written again with other numbers.
    """

    def __init__(
        self, arrays: Mapping[str, np.ndarray], *, settable: bool = False, decided: Sequence[bool] | None = None
    ):
        self.arrays, self._settable = dict(arrays), settable
        self._decided = None if decided is None else iter(decided)
        self.decisions: list[bool] = []
        """Which of all numbers have a column, in the order in which they were asked for."""
        self.values: list[np.ndarray] = []
        """What the columns hold, ``[W]`` each."""

    def differ(self, values: np.ndarray) -> bool:
        """Return whether some values ``[W]`` have a column."""
        out = bool((self._settable and len(values) > 1 and np.any(values)) or np.ptp(values) > 0.0)
        if self._decided is not None:
            out = next(self._decided)
        self.decisions.append(out)
        return out

    def index(self, values: np.ndarray) -> int:
        """Column of some values ``[W]``, -1 where all are alike."""
        if not self.differ(values):
            return -1
        for i, column in enumerate(() if self._settable else self.values):
            if np.array_equal(column, values):
                return i
        self.values.append(values)
        return len(self.values) - 1

    def constant(self, values: np.ndarray) -> float:
        """The number that the source has for values ``[W]``: the first, or zero where it must not depend on them."""
        return 0.0 if self._settable and self.differ(values) else float(values[0])

    def operand(self, values: np.ndarray) -> Operand:
        """Values of all worlds ``[W]``, or of one ``[1]``, as an operand of baked source."""
        column = self.index(values)
        return float(values[0]) if column < 0 else f"w.par[{column}]"


class Structure:
    """A compiled MuJoCo model with arrays that may differ between worlds, and what follows from its tree of bodies.

    Args:
        model: The model.
        arrays: Its arrays that differ between worlds, ``[W, ...]`` each; ``gravity`` is among them.
        settable: Whether all numbers of these arrays may be set anew without other source.
        decided: Which numbers have columns, from a model whose source is to be written again.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        arrays: Mapping[str, np.ndarray] | None = None,
        *,
        settable: bool = False,
        decided: Sequence[bool] | None = None,
    ):
        self.mj, self.columns = model, Columns(arrays or {}, settable=settable, decided=decided)
        self._mixed: set[tuple[float, ...]] = set()

    def off(self, part: str) -> bool:
        """Return whether a flag of the options disables a part of the physics, ``SPRING`` for example."""
        flag = getattr(mujoco.mjtDisableBit, f"mjDSBL_{part}")
        return bool(self.mj.opt.disableflags & flag)

    def drives(self, actuator: int) -> bool:
        """Return whether an actuator is on: neither all are disabled nor its group is."""
        group = int(self.mj.actuator_group[actuator])
        grouped = 0 <= group <= MOST_GROUP and self.mj.opt.disableactuator >> group & 1
        return not (self.off("ACTUATION") or grouped)

    @cached_property
    def gravity(self) -> Vector:
        """Acceleration of gravity [m/s²], zero where the options disable it."""
        if self.off("GRAVITY"):
            return NOTHING[:]
        return [self.columns.operand(self.array("gravity")[:, k]) for k in range(3)]

    @property
    def explicit(self) -> bool:
        """Return whether velocities follow from the solver's accelerations, since no damping is implicit."""
        m, kinds = self.mj, mujoco.mjtIntegrator
        damped = self.dampings.any() and not self.off("EULERDAMP")
        return m.opt.integrator == int(kinds.mjINT_RK4) or (m.opt.integrator == int(kinds.mjINT_EULER) and not damped)

    @property
    def large(self) -> bool:
        """Return whether a model has so many degrees of freedom that a world is a thread's alone."""
        return self.mj.nv > MOST_SHARED

    @property
    def skewed(self) -> bool:
        """Return whether the step takes the derivatives of bias forces by velocity, whose matrix is not symmetric."""
        return self.mj.opt.integrator == int(mujoco.mjtIntegrator.mjINT_IMPLICIT)

    @property
    def implicit(self) -> bool:
        """Return whether the step takes derivatives of forces by velocity: ``implicit`` or ``implicitfast``."""
        return self.skewed or self.mj.opt.integrator == int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)

    @property
    def fluid(self) -> bool:
        """Return whether a fluid resists bodies."""
        return bool(self.mj.opt.density or self.mj.opt.viscosity) and self.passive

    @property
    def passive(self) -> bool:
        """Return whether there are passive forces: without springs and dampers MuJoCo has no others of them either."""
        return not (self.off("SPRING") and self.off("DAMPER"))

    def lift(self, body: int) -> float:
        """Share of a body's weight that is compensated."""
        return float(self.mj.body_gravcomp[body]) if self.passive else 0.0

    def array(self, name: str) -> np.ndarray:
        """An array of the model with a first axis for worlds, of length 1 where all are alike."""
        found = self.columns.arrays.get(name)
        if found is not None:
            return found
        return (self.mj.opt.gravity if name == "gravity" else getattr(self.mj, name))[None]

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
        """Return whether joints move a body."""
        return bool(self.body_dofs[body])

    def subtree(self, root: int) -> list[int]:
        """A body and all below it, that one first."""
        out = [root]
        for body in range(root + 1, self.mj.nbody):
            if int(self.mj.body_parentid[body]) in out:
                out.append(body)
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

    @property
    def mocap_rest(self) -> np.ndarray:
        """Poses of the mocap bodies ``[NMOCAP, 7]`` as the model has them, in the order of their mocap numbers."""
        m = self.mj
        bodies = sorted(np.flatnonzero(m.body_mocapid >= 0).tolist(), key=lambda body: int(m.body_mocapid[body]))
        return np.hstack([m.body_pos, m.body_quat])[bodies] if bodies else np.zeros((1, 7))

    def slides(self, dof: int) -> bool:
        """Return whether a degree of freedom turns nothing."""
        m, joint = self.mj, int(self.mj.dof_jntid[dof])
        kind = int(m.jnt_type[joint])
        return kind == SLIDE or (kind == FREE and dof < int(m.jnt_dofadr[joint]) + 3)

    def rows(self, solref: np.ndarray, solimp: np.ndarray) -> Rows:
        """Soft constraint parameters with this model's options."""
        if mixed(solref):
            self._mixed.add(tuple(float(x) for x in solref))
        return Rows.of(solref, solimp, float(self.mj.opt.timestep), safe=not self.off("REFSAFE"))

    def warn(self) -> None:
        """Log what MuJoCo warns of, once the source of the model is written."""
        for solref in sorted(self._mixed):
            logger.warning("solref %g %g mixes its two formats: %g %g in its place, as in MuJoCo", *solref, *REFERENCE)

    @cached_property
    def standing(self) -> list[int]:
        """Geoms that neither joints nor mocap bodies move."""
        m = self.mj
        rooted = [int(m.body_mocapid[m.body_rootid[m.geom_bodyid[g]]]) for g in range(m.ngeom)]
        return [g for g in range(m.ngeom) if rooted[g] < 0 and not self.moves(int(m.geom_bodyid[g]))]

    @cached_property
    def tendon_dofs(self) -> list[tuple[int, ...]]:
        """Degrees of freedom that change the length of each tendon."""
        m, out = self.mj, []
        for n in range(m.ntendon):
            found: set[int] = set()
            last: frozenset[int] | None = None
            for k in wraps(m, n):
                if m.wrap_type[k] == WRAP_JOINT:
                    found.add(int(m.jnt_dofadr[m.wrap_objid[k]]))
                elif m.wrap_type[k] == WRAP_PULLEY:
                    last = None
                else:
                    bodies = m.site_bodyid if m.wrap_type[k] == WRAP_SITE else m.geom_bodyid
                    chain = self.body_dofs[bodies[m.wrap_objid[k]]]
                    found |= chain ^ last if last is not None else frozenset()
                    last = chain
            out.append(tuple(sorted(found)))
        return out

    @cached_property
    def armatures(self) -> np.ndarray:
        """Armature of each degree of freedom, with those of actuators ``[nv]``."""
        m = self.mj
        return m.dof_armature + self._geared(m.actuator_armature, m.jnt_actuatorid, _ON_JOINTS)[m.dof_jntid]

    @cached_property
    def line_armatures(self) -> np.ndarray:
        """The same of each tendon ``[ntendon]``."""
        m = self.mj
        return m.tendon_armature + self._geared(m.actuator_armature, m.tendon_actuatorid, _ON_TENDONS)

    @cached_property
    def dampings(self) -> np.ndarray:
        """Damping of each degree of freedom, with that of actuators, by powers of its speed ``[nv, 1 + npoly]``.

        It is zero where it is disabled.
        """
        m = self.mj
        own, more = powers(m, "dof_damping"), powers(m, "actuator_damping")
        damping = own + self._geared(more, m.jnt_actuatorid, _ON_JOINTS)[m.dof_jntid]
        return np.zeros_like(damping) if self.off("DAMPER") else damping

    def drawn_damping(self, dof: int) -> Operand:
        """What a world's own damping of a degree of freedom is above that of the model."""
        more = self.array("dof_damping")[:, dof] - self.mj.dof_damping[dof]
        return 0.0 if self.off("DAMPER") else self.columns.operand(more)

    @cached_property
    def line_dampings(self) -> np.ndarray:
        """The same of each tendon ``[ntendon, 1 + npoly]``."""
        m = self.mj
        own, more = powers(m, "tendon_damping"), powers(m, "actuator_damping")
        damping = own + self._geared(more, m.tendon_actuatorid, _ON_TENDONS)
        return np.zeros_like(damping) if self.off("DAMPER") else damping

    def _geared(self, numbers: np.ndarray, owner: np.ndarray, kinds: tuple[int, ...]) -> np.ndarray:
        """Numbers of actuators times squares of their gears, added up by what they drive.

        Args:
            numbers: Of the actuators.
            owner: The one actuator of each joint or tendon that counts; -1 if none does, -2 if all do.
            kinds: Transmissions.
        """
        m, out = self.mj, np.zeros((len(owner), *numbers.shape[1:]))
        for a in np.flatnonzero(np.isin(m.actuator_trntype, kinds)):
            target = int(m.actuator_trnid[a, 0])
            if owner[target] in (a, -2):
                out[target] += numbers[a] * m.actuator_gear[a, 0] ** 2
        return out

    @cached_property
    def tendon_armatures(self) -> dict[tuple[int, int], float]:
        """Contribution of tendons' armatures along joints to the mass matrix, entry by entry (row, column ≤ row)."""
        m = self.mj
        out: dict[tuple[int, int], float] = {}
        for n in np.flatnonzero(self.line_armatures):
            if m.wrap_type[m.tendon_adr[n]] != WRAP_JOINT:
                continue
            factors = {int(m.jnt_dofadr[m.wrap_objid[k]]): float(m.wrap_prm[k]) for k in wraps(m, int(n))}
            for i, a in factors.items():
                for j, b in factors.items():
                    if j == i or j in self.ancestors[i]:
                        out[i, j] = out.get((i, j), 0.0) + float(self.line_armatures[n]) * a * b
        return out
