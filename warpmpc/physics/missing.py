# SPDX-License-Identifier: Apache-2.0
"""Features of MuJoCo models that the engine ``fused`` lacks."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from .base import BALL, FREE, GEOM
from .factor import MOST_OPERATIONS, operations
from .flags import lacking_flags
from .kinds import lacking_kinds
from .mobility import singular
from .model import COLLIDES, NEWTON, PhysicsModel
from .tendons import fixed

if TYPE_CHECKING:
    from collections.abc import Callable

logger = logging.getLogger("warpmpc")


def missing(model: mujoco.MjModel) -> str | None:
    """Return what a model has and this engine lacks, in a few words; None if there is nothing."""
    physics = PhysicsModel(model)
    if unknown := list(lacking_flags(model)):
        return f"physics of the flags {', '.join(unknown)}"
    for lacks in lacking_kinds(model):
        return lacks
    for what, wrong in _CHECKS.items():
        if wrong(physics):
            return what
    kinds = {tuple(int(model.geom_type[g]) for g in pair.geoms) for pair in physics.pairs}
    for a, b in sorted(kinds - COLLIDES):
        return f"contacts between {_names((a, b))}"
    return None


def tell_differences(model: mujoco.MjModel) -> None:
    """Say in the log how steps of a model are computed otherwise than it says."""
    if model.opt.solver != NEWTON:
        name = mujoco.mjtSolver(model.opt.solver).name.removeprefix("mjSOL_")
        logger.info("constraints are solved by Newton's method to its tolerance, in place of the model's %s", name)


def _names(pair: tuple[int, int]) -> str:
    return " and ".join(GEOM(kind).name.removeprefix("mjGEOM_").lower() for kind in pair)


def _ball_feedback(p: PhysicsModel) -> bool:
    """Return whether a force on a ball joint depends on its angle."""
    m = p.mj
    kinds = mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT
    joints = np.flatnonzero(np.isin(m.actuator_trntype, [int(kind) for kind in kinds]))
    balls = joints[m.jnt_type[m.actuator_trnid[joints, 0]] == BALL]
    return bool((m.actuator_gainprm[balls, 1] != 0.0).any() or (m.actuator_biasprm[balls, 1] != 0.0).any())


def _in_parent(p: PhysicsModel) -> bool:
    """Return whether actuators drive ball or free joints in the frame of the parent."""
    joints = p.mj.actuator_trnid[p.mj.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINTINPARENT), 0]
    return bool(np.isin(p.mj.jnt_type[joints], (FREE, BALL)).any())


def _contacts(p: PhysicsModel) -> np.ndarray:
    """Geoms that may touch anything."""
    return np.array(sorted({g for pair in p.pairs for g in pair.geoms}), dtype=int)


MOST_DOFS = 128
"""Degrees of freedom of a model that compiles within a minute."""
_CHECKS: dict[str, Callable[[PhysicsModel], object]] = {
    f"models of more than {MOST_DOFS} degrees of freedom": lambda p: p.mj.nv > MOST_DOFS,
    "armatures of tendons along sites": lambda p: any(
        not fixed(p.mj, int(t)) for t in np.flatnonzero(p.mj.tendon_armature)
    ),
    "limits of the forces of actuators on tendons": lambda p: p.mj.tendon_actfrclimited.any(),
    "plugins": lambda p: p.mj.nplugin,
    "flexible bodies": lambda p: p.mj.nflex,
    "adhesion of contacts": lambda p: p.mj.geom_adhesion.any() or p.mj.pair_adhesion.any(),
    "velocities of surfaces (surfacevel)": lambda p: p.mj.geom_surfacevel.any(),
    "references of their own for the friction of explicit pairs": lambda p: (
        p.mj.opt.cone and p.mj.pair_solreffriction.any()
    ),
    "limited actuator forces of ball and free joints": lambda p: p.mj.jnt_actfrclimited[
        np.isin(p.mj.jnt_type, (FREE, BALL))
    ].any(),
    "gravity compensation by actuators": lambda p: p.mj.jnt_actgravcomp.any(),
    "actuators of several activations": lambda p: (
        p.mj.na != np.sum(p.mj.actuator_dyntype != int(mujoco.mjtDyn.mjDYN_NONE))
    ),
    "actuators of ball and free joints in their parents' frames": _in_parent,
    "actuators with feedback of the angle of a ball joint": lambda p: _ball_feedback(p),
    "actuators at a site with a reference": lambda p: (
        p.mj.actuator_trnid[p.mj.actuator_trntype == int(mujoco.mjtTrn.mjTRN_SITE), 1] >= 0
    ).any(),
    "actuators of several controls": lambda p: (p.mj.actuator_ctrlnum != 1).any() or (p.mj.actuator_outnum != 1).any(),
    "armatures of actuators": lambda p: p.mj.actuator_armature.any(),
    "delays and intervals (history in the state)": lambda p: p.mj.nhistory,
    "shapes of their own in a fluid": lambda p: (
        (p.mj.opt.density or p.mj.opt.viscosity) and (p.mj.geom_fluid[:, 0] > 0.0).any()
    ),
    "damping and stiffness that depend on speed and angle": lambda p: (
        p.mj.dof_dampingpoly.any()
        or p.mj.jnt_stiffnesspoly.any()
        or p.mj.actuator_damping.any()
        or p.mj.actuator_dampingpoly.any()
        or p.mj.tendon_dampingpoly.any()
        or p.mj.tendon_stiffnesspoly.any()
    ),
    "solver PGS for elliptic cones": lambda p: p.mj.opt.solver == int(mujoco.mjtSolver.mjSOL_PGS) and p.elliptic,
    f"trees of more than {MOST_DOFS // 2} degrees of freedom in a row": lambda p: (
        operations(p.ancestors) > MOST_OPERATIONS
    ),
    "noslip iterations": lambda p: p.mj.opt.noslip_iterations,
    "fewer than 20 solver iterations for contacts as hard as low friction, impratio or solimp make these": lambda p: (
        p.few and p.hard
    ),
    "pyramids without friction at bodies that turn about their centre of mass (condim 1 mends it)": lambda p: p.pinned,
    "double precision for a nearly singular mass matrix (armatures mend it)": lambda p: singular(p.mj),
}
"""What this engine lacks, and how to see that a model has it."""
