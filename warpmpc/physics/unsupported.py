# SPDX-License-Identifier: Apache-2.0
"""Features of MuJoCo models that the engine ``fused`` lacks.

Flags of MuJoCo's options: which are heeded, which change no state, and which are refused.

Kinds of actuators, tendons' ways and equalities, by the names of MuJoCo's enumerations: read, or refused.

MuJoCo's callbacks (``mjcb_control``, ...), which change its physics for a whole process and do not change ours.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import mujoco
import numpy as np

from .base import BALL, FREE, GEOM, WRAP_CYLINDER, WRAP_SPHERE, wraps
from .factor import MOST_OPERATIONS, operations
from .mobility import singular
from .model import COLLIDES, NEWTON, PhysicsModel
from .version import yields

if TYPE_CHECKING:
    from collections.abc import Callable


class Kinds(NamedTuple):
    """One enumeration."""

    what: str
    array: str
    """Of the model."""
    enum: type
    read: str
    refused: str
    """The other names: those of callbacks, plugins and deformable bodies, and what is not written yet."""


KINDS = (
    Kinds("dynamics of actuators", "actuator_dyntype", mujoco.mjtDyn, "NONE INTEGRATOR FILTER FILTEREXACT MUSCLE",
          "PID DCMOTOR USER"),
    Kinds("gains of actuators", "actuator_gaintype", mujoco.mjtGain, "FIXED AFFINE MUSCLE", "PID DCMOTOR SO3 USER"),
    Kinds("biases of actuators", "actuator_biastype", mujoco.mjtBias, "NONE AFFINE MUSCLE", "DCMOTOR SO3 USER"),
    Kinds("transmissions of actuators", "actuator_trntype", mujoco.mjtTrn,
          "JOINT JOINTINPARENT TENDON SITE SLIDERCRANK",
          "BODY SO3 UNDEFINED"),
    Kinds("ways of tendons", "wrap_type", mujoco.mjtWrap, "JOINT PULLEY SITE SPHERE CYLINDER", "NONE"),
    Kinds("equalities", "eq_type", mujoco.mjtEq, "CONNECT WELD JOINT TENDON", "FLEX FLEXVERT FLEXSTRAIN DISTANCE"),
    Kinds("joints", "jnt_type", mujoco.mjtJoint, "FREE BALL SLIDE HINGE", ""),
)  # fmt: skip


def lacking_kinds(model: mujoco.MjModel) -> Iterator[str]:
    """What a model has of kinds that are not read, in a few words each."""
    for kinds in KINDS:
        found = {_name(kinds.enum, int(kind)) for kind in getattr(model, kinds.array)}
        if unread := sorted(found - set(kinds.read.split())):
            yield f"{kinds.what}: {', '.join(unread)}"


def _name(enum: type, kind: int) -> str:
    """A member's name without that of its enumeration, or its number where this MuJoCo has none."""
    names = {int(member): name.split("_", 1)[1] for name, member in enum.__members__.items()}
    return names.get(kind, str(kind))


HEEDED = {
    "DSBL_CONSTRAINT", "DSBL_EQUALITY", "DSBL_FRICTIONLOSS", "DSBL_LIMIT", "DSBL_CONTACT", "DSBL_SPRING", "DSBL_DAMPER",
    "DSBL_GRAVITY", "DSBL_CLAMPCTRL", "DSBL_FILTERPARENT", "DSBL_ACTUATION", "DSBL_REFSAFE", "DSBL_SENSOR",
    "DSBL_EULERDAMP", "DSBL_MULTICCD", "ENBL_OVERRIDE",
}  # fmt: skip
"""Flags that the step follows."""
WITHOUT_EFFECT = {
    "DSBL_WARMSTART", "DSBL_MIDPHASE", "DSBL_NATIVECCD", "DSBL_AUTORESET", "DSBL_ISLAND", "ENBL_ENERGY", "ENBL_FWDINV",
    "ENBL_INVDISCRETE",
}  # fmt: skip
"""Flags that change how MuJoCo computes a step and what it reports, but not where a converged step ends."""
REFUSED = {"ENBL_SLEEP", "ENBL_DIAGEXACT", "ENBL_IPC", "ENBL_SPECULATIVE"}
"""Flags whose physics is lacking; so is that of flags that this list does not know."""


def lacking_flags(model: mujoco.MjModel) -> Iterator[str]:
    """Names of the flags that are set in a model and refused."""
    for kind, bits in ((mujoco.mjtDisableBit, model.opt.disableflags), (mujoco.mjtEnableBit, model.opt.enableflags)):
        names = {int(bit): name.removeprefix("mj") for name, bit in kind.__members__.items() if "BL_" in name}
        for bit in (1 << n for n in range(31) if bits >> n & 1):
            name = names.get(bit, f"{kind.__name__} {bit}")
            if name not in HEEDED | WITHOUT_EFFECT:
                yield name


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
    "activations of servoed rotations with RK4 (implicitfast mends it)": lambda p: (
        p.mj.opt.integrator == int(mujoco.mjtIntegrator.mjINT_RK4) and _servoes_rotation(p)
    ),
    "delays and intervals (history in the state)": lambda p: p.mj.nhistory,
    'ellipsoid models of fluid forces (fluidshape="none" mends it)': lambda p: (
        (p.mj.opt.density or p.mj.opt.viscosity) and (p.mj.geom_fluid[:, 0] > 0.0).any()
    ),
    "stiffness of ball and free joints that grows with the angle": lambda p: p.mj.jnt_stiffnesspoly[
        np.isin(p.mj.jnt_type, (FREE, BALL))
    ].any(),
    "solvers that MuJoCo does not have": lambda p: p.mj.opt.solver not in _SOLVERS,
    "solver PGS for elliptic cones (Newton mends it)": lambda p: (
        p.mj.opt.solver == int(mujoco.mjtSolver.mjSOL_PGS) and p.elliptic
    ),
    f"trees of more than {MOST_DOFS // 2} degrees of freedom in a row": lambda p: (
        operations(p.ancestors) > MOST_OPERATIONS
    ),
    'noslip iterations (noslip_iterations="0" mends it)': lambda p: p.mj.opt.noslip_iterations,
    "few solver iterations for contacts as hard as low friction, impratio or solimp make (10 mend it)": lambda p: (
        p.few and p.hard
    ),
    "pyramids without friction at bodies that turn about their centre of mass (condim 1 mends it)": lambda p: p.pinned,
    "double precision for a nearly singular mass matrix (armatures mend it)": lambda p: singular(p.mj),
}
"""What this engine lacks, and how to see that a model has it."""


_GETTERS = {
    name.removeprefix("get_"): getattr(mujoco, name)
    for name in sorted(vars(mujoco))
    if name.startswith("get_mjcb_") and name != "get_mjcb_time"  # a clock for timers
}


def callbacks() -> str | None:
    """Return the callbacks that are installed now, in a few words; None if there are none."""
    names = [name for name, installed in _GETTERS.items() if installed() is not None]
    return f"callbacks ({', '.join(names)})" if names else None
