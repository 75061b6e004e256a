# SPDX-License-Identifier: Apache-2.0
"""The types of the simulated plant: what befalls it, what moves by itself and how both are observed.

The types of what is drawn: properties of worlds, and the task of an episode.

The types of the engine: the physics of the rollouts.
"""

from __future__ import annotations

from enum import StrEnum, nonmember
from itertools import pairwise
from typing import Annotated

from pydantic import Field, field_validator, model_validator

from .registry import ENGINES, Name
from .schema_estimate import Sensors
from .types import Count, Finite, Flag, Floats, Fraction, Natural, NonNegative, Param, Positive, Section, Vec3


class Kick(Section):
    """A kick: a sudden change of velocity of an object or of a robot's joints."""

    time: NonNegative
    """Time of the kick [s]."""
    target: str
    """Object or robot."""
    velocity: Floats
    """Object, or robot with a free root: change of linear velocity (x, y, z) [m/s]. Robot: change of each joint's
    velocity [m/s or rad/s], of a free root the linear one."""


class PlantNoise(Section):
    """Gaussian observation noise, as standard deviations."""

    position: NonNegative = 0.0
    """Joint positions and object positions [m or rad]."""
    velocity: NonNegative = 0.0
    """Velocities [m/s or rad/s]."""


class PlantFactors(Section):
    """Factors by which a body of the plant differs from the planner's model."""

    mass: Positive = 1.0
    """Factor on every mass."""
    friction: NonNegative = 1.0
    """Factor on every coefficient of friction."""
    size: Positive = 1.0
    """Factor on the dimensions of an object or obstacle; its mass stays."""


class PlantSettings(Section):
    """Differences of the simulated plant from the planner's worlds."""

    substeps: Count | None = None
    """Physics steps per control. When left out, from the timestep of the MJCF file, else 8."""
    randomize: Flag = True
    """Whether properties of the plant are drawn from ``[randomize]``, independently of the rollouts."""
    factor: dict[str, PlantFactors] = Field(default_factory=dict)
    """Robot, object or obstacle → factors on its properties in the plant alone: errors of the planner's model."""
    noise: PlantNoise = PlantNoise()
    """Noise of observations."""
    delay: NonNegative = 0.0
    """Age of observations [s], rounded to whole controls. Scenes with an estimator predict them to the present."""
    sensor: Sensors = Sensors()
    """Sensors that measure at their own rates."""
    kicks: tuple[Kick, ...] = ()
    """Sudden changes of velocity during the run."""


class Seen(Section):
    """Observation of something that moves."""

    rate: Positive | None = None
    """Observations a second [1/s]; one for every control when left out."""
    noise: NonNegative = 0.0
    """Standard deviation of every observed coordinate [m]."""
    lead: NonNegative = 0.0
    """How far ahead of the present the planner is shown it, on a straight line through what was observed last [s];
    0 shows the last observation as it was."""
    over: Positive = 0.3
    """Time of the observations that the line is laid through [s]."""


class Motion(Section):
    """Motion of a pose of the task in a simulated plant: the goal, a target or a movable obstacle."""

    name: str
    """``goal``, or the target or movable obstacle."""
    through: Annotated[tuple[Vec3, ...], Field(min_length=2)]
    """Points of a smooth path without overshoot [m]; it waits between equal points."""
    times: tuple[NonNegative, ...] | None = None
    """Times of the points [s], from 0 on; evenly over the period when left out."""
    period: Positive | None = None
    """Period of a closed path [s]; without one it stays at the last point."""
    start: Finite = 0.0
    """Time at which it starts to move [s]; may be negative."""
    seen: Seen = Seen()
    """How the planner observes it."""

    @model_validator(mode="after")
    def _in_order(self) -> Motion:
        times, period = self.times, self.period
        if times is None:
            if period is None:
                raise ValueError("a motion needs a period, or times of its points")
            return self
        if len(times) != len(self.through):
            raise ValueError(f"there are {len(self.through)} points and {len(times)} times")
        if times[0] != 0.0 or any(a >= b for a, b in pairwise(times)):
            raise ValueError("times begin with 0 and grow")
        if period is not None and period <= times[-1]:
            raise ValueError("the period ends after the last of the times")
        return self


class Uniform(Section):
    """A fraction of the nominal value, uniform in ± ``uniform``."""

    uniform: Fraction
    """Largest deviation, as a fraction of the nominal value."""
    ends: Flag = False
    """Whether it is off by the whole of it always, up or down."""


class Normal(Section):
    """A Gaussian with standard deviation ``normal``."""

    normal: NonNegative
    """Standard deviation [m]."""


class Randomization(Section):
    """Random physical properties of one robot, object or obstacle, drawn per world."""

    mass: Uniform | None = None
    """Factor on every mass."""
    friction: Uniform | None = None
    """Factor on every coefficient of friction."""
    size: Normal | None = None
    """Added to each dimension [m]."""
    redraw: Flag = False
    """Whether rollouts draw new values in every plan."""


class Draw(Section):
    """Uniform draw of a scene key at the start of an episode."""

    low: Floats
    """Least value, in the unit of the key that is drawn: one, or one for each of its numbers."""
    high: Floats
    """Largest value, likewise."""

    @model_validator(mode="after")
    def _ordered(self) -> Draw:
        if len(self.low) != len(self.high) or any(lo > hi for lo, hi in zip(self.low, self.high, strict=False)):
            raise ValueError("a draw needs low = [...] and high = [...] of one length with low ≤ high")
        return self


class Rejection(Section):
    """Draws in which a place lies too close to an obstacle are drawn again."""

    place: str
    """``goal``, an object, a robot (the start position of its root), or a robot frame (``robot/frame``) with ``at``."""
    at: Vec3 | None = None
    """Where the place is at the start [m], for robots whose joints carry them away from their root."""
    clearance: NonNegative
    """Least distance from the obstacles' surfaces [m]."""


class RandomizeTask(Section):
    """Goals, starts and obstacles drawn anew for every episode, from its seed."""

    draw: dict[str, Draw] = Field(default_factory=dict)
    """Scene key (as in ``--set``, ``*`` for every name) → range; false in a variant removes one."""
    reject: tuple[Rejection, ...] = ()
    """Draws that are rejected and drawn again."""

    @field_validator("draw", mode="before")
    @classmethod
    def _left_out(cls, draw: object) -> object:
        return {key: value for key, value in draw.items() if value is not False} if isinstance(draw, dict) else draw


class EngineName(Name):
    """Engines of rollouts."""

    AUTO = "auto"
    MUJOCO = "mujoco"
    MUJOCO_WARP = "mujoco_warp"
    NEWTON = "newton"
    KINEMATIC = "kinematic"
    FUSED = "fused"

    registry = nonmember(ENGINES)


class Solver(StrEnum):
    """Solvers of the engine ``newton``."""

    MUJOCO = "mujoco"
    XPBD = "xpbd"


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
    """Physics of the rollouts. Keys that are left out come from ``<option>`` of the first MJCF file, else from here."""

    name: EngineName = EngineName.AUTO
    """Engine of the rollouts, also a registered one; ``auto``: the first that supports the scene."""
    substeps: Count | None = None
    """Physics steps per step of a rollout. When left out, from the timestep of the MJCF file, or a half or a quarter of
    them if rollouts hardly change; else 2, at most 0.02 s long."""
    threads: Annotated[Natural, Field(le=1024)] = 0
    """CPU threads; 0 means one per core."""
    iterations: Count | None = None
    """Largest number of constraint solver iterations; else the MJCF file's, or 20."""
    tolerance: NonNegative | None = None
    """Constraint solver tolerance; else the MJCF file's, or 1e-6."""
    gravity: Vec3 | None = None
    """Gravity of the rollouts and of the plant (x, y, z) [m/s²]; else the MJCF file's, or (0, 0, -9.81)."""
    integrator: Integrator | None = None
    """Of the rollouts and of the plant; else the MJCF file's, or ``implicitfast``."""
    cone: Cone | None = None
    """Friction cone of the rollouts and of the plant; else the MJCF file's, or ``pyramidal``."""
    impratio: Positive | None = None
    """Ratio of friction to normal impedance of contacts, of rollouts and plant; else the MJCF file's, or 1."""
    friction_combine: FrictionCombine | None = None
    """Friction of a contact, in rollouts and plant: ``average`` of both (PhysX), or ``priority``: the object's, else
    the larger (MuJoCo). When left out ``priority``, but ``average`` if ``randomize`` draws friction of more than a
    single object. Newton's solver ``mujoco`` has ``priority`` alone, ``xpbd`` ``average`` alone."""
    solver: Solver = Solver.MUJOCO
    """``newton``: its solver ``SolverMuJoCo`` (``mujoco``) or ``SolverXPBD`` (``xpbd``)."""
    options: dict[str, Param] = Field(default_factory=dict)
    """``mujoco_warp``, ``newton``: further options of the solver, by name."""
