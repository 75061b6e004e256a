# SPDX-License-Identifier: Apache-2.0
"""The types of the engine: the physics of the rollouts."""

from __future__ import annotations

from enum import StrEnum, nonmember

from pydantic import Field

from ..registry import ENGINES, Name
from .types import Count, Natural, NonNegative, Param, Positive, Section


class EngineName(Name):
    """Engines of rollouts."""

    AUTO = "auto"
    MUJOCO = "mujoco"
    NEWTON = "newton"
    KINEMATIC = "kinematic"
    FUSED = "fused"

    registry = nonmember(ENGINES)


class Solver(StrEnum):
    """Solvers of the engine ``newton``: MuJoCo Warp, and Newton's own."""

    MUJOCO = "mujoco"
    XPBD = "xpbd"
    FEATHERSTONE = "featherstone"
    SEMI_IMPLICIT = "semi_implicit"
    STEEL = "steel"
    KAMINO = "kamino"


class Integrator(StrEnum):
    """Integrators by which MuJoCo moves on from accelerations to velocities and positions."""

    EULER = "euler"
    RK4 = "rk4"
    IMPLICIT = "implicit"
    IMPLICITFAST = "implicitfast"


class Cone(StrEnum):
    """MuJoCo's friction cone."""

    PYRAMIDAL = "pyramidal"
    ELLIPTIC = "elliptic"


class FrictionCombine(StrEnum):
    """Friction of two surfaces that touch."""

    PRIORITY = "priority"
    AVERAGE = "average"


class EngineSettings(Section):
    """The physics of the rollouts.

    What is left out is as the ``<option>`` of the scene's first MJCF file says, or as said here where there is none.
    """

    name: EngineName = EngineName.AUTO
    """Engine of the rollouts, a registered one among them; ``auto``: the first that can do what the scene asks for."""
    substeps: Count | None = None
    """Physics steps in a step of a rollout; else as the MJCF file's timestep asks for, a half or a quarter as many
    where that hardly changes rollouts, or 2, none longer than 0.02 s."""
    threads: Natural = 0
    """CPU threads; 0 means one per core."""
    iterations: Count | None = None
    """Largest number of constraint solver iterations; else the MJCF file's, or 20."""
    tolerance: NonNegative | None = None
    """Constraint solver tolerance; else the MJCF file's, or 1e-6."""
    integrator: Integrator | None = None
    """Of the rollouts and of the plant; else the MJCF file's, or ``implicitfast``."""
    cone: Cone | None = None
    """Friction cone of the rollouts and of the plant; else the MJCF file's, or ``pyramidal``."""
    impratio: Positive | None = None
    """Ratio of friction to normal impedance of contacts, of rollouts and plant; else the MJCF file's, or 1."""
    friction_combine: FrictionCombine | None = None
    """Friction where two things touch, in rollouts and plant: ``average`` of both (PhysX), or ``priority``, an
    object's own, else the larger (MuJoCo). Left out it is ``priority``, but ``average`` where ``randomize`` draws the
    friction of anything but the only object: every draw counts. Newton's own solvers always take the average."""
    solver: Solver = Solver.MUJOCO
    """``newton``: MuJoCo Warp, which is called directly (``mujoco``), or another solver, of Newton's."""
    options: dict[str, Param] = Field(default_factory=dict)
    """``newton``: further options, passed to the solver's constructor by name."""
