# SPDX-License-Identifier: Apache-2.0
"""Features of MuJoCo models that the engine ``fused`` lacks."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from .base import BALL, FREE, GEOM, WRAP_CYLINDER, WRAP_SPHERE, wraps
from .factor import MOST_OPERATIONS, operations
from .flags import lacking_flags
from .kinds import lacking_kinds
from .mobility import singular
from .model import COLLIDES, NEWTON, PhysicsModel
from .version import yields

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


def _servoes_rotation(p: PhysicsModel) -> bool:
    """Return whether setpoints of rotations are activations."""
    m, kinds = p.mj, mujoco.mjtTrn
    kept = (m.actuator_dyntype == int(mujoco.mjtDyn.mjDYN_INTEGRATOR)) & (m.actuator_biasprm[:, 1] != 0.0)
    between = (m.actuator_trntype == int(kinds.mjTRN_SITE)) & (m.actuator_trnid[:, 1] >= 0)
    on_joint = np.isin(m.actuator_trntype, (int(kinds.mjTRN_JOINT), int(kinds.mjTRN_JOINTINPARENT)))
    balls = [bool(on_joint[a]) and m.jnt_type[m.actuator_trnid[a, 0]] == BALL for a in range(len(kept))]
    return bool((kept & (between | np.array(balls, dtype=bool))).any())


def _contacts(p: PhysicsModel) -> np.ndarray:
    """Geoms that may touch anything."""
    return np.array(sorted({g for pair in p.pairs for g in pair.geoms}), dtype=int)


_SOLVERS = [int(solver) for solver in mujoco.mjtSolver.__members__.values()]
MOST_DOFS = 128
"""Degrees of freedom of a model that compiles within a minute."""
_CHECKS: dict[str, Callable[[PhysicsModel], object]] = {
    f"models of more than {MOST_DOFS} degrees of freedom": lambda p: p.mj.nv > MOST_DOFS,
    "armatures of tendons around shapes": lambda p: any(
        np.isin(p.mj.wrap_type[list(wraps(p.mj, int(t)))], (WRAP_SPHERE, WRAP_CYLINDER)).any()
        for t in np.flatnonzero(p.line_armatures)
    ),
    "plugins": lambda p: p.mj.nplugin,
    "springs that yield (springyield)": lambda p: yields(p.mj),
    "flexible bodies": lambda p: p.mj.nflex,
    "adhesion of contacts": lambda p: p.mj.geom_adhesion.any() or p.mj.pair_adhesion.any(),
    "velocities of surfaces (surfacevel)": lambda p: p.mj.geom_surfacevel.any(),
    "actuators of several activations": lambda p: (
        p.mj.na != np.sum(p.mj.actuator_dyntype != int(mujoco.mjtDyn.mjDYN_NONE))
    ),
    "actuators of several controls": lambda p: (p.mj.actuator_ctrlnum != 1).any() or (p.mj.actuator_outnum != 1).any(),
    "activations of servoed rotations with RK4": lambda p: (
        p.mj.opt.integrator == int(mujoco.mjtIntegrator.mjINT_RK4) and _servoes_rotation(p)
    ),
    "delays and intervals (history in the state)": lambda p: p.mj.nhistory,
    "shapes of their own in a fluid": lambda p: (
        (p.mj.opt.density or p.mj.opt.viscosity) and (p.mj.geom_fluid[:, 0] > 0.0).any()
    ),
    "stiffness of ball and free joints that grows with the angle": lambda p: p.mj.jnt_stiffnesspoly[
        np.isin(p.mj.jnt_type, (FREE, BALL))
    ].any(),
    "solvers that are none of MuJoCo's": lambda p: p.mj.opt.solver not in _SOLVERS,
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
