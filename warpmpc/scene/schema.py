# SPDX-License-Identifier: Apache-2.0
"""The types of a scene: what a scene file may say, and what Python may build instead.

Every type is frozen. Units are SI: metres, kilograms, seconds, radians, newtons. Quaternions are ``(x, y, z, w)``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field, ValidationInfo, field_validator, model_validator

from .schema_agent import AgentSettings, SafeCommand
from .schema_ancillary import Ancillary
from .schema_bodies import (
    Drive,
    DriveMode,
    Frame,
    Ground,
    Object,
    Obstacle,
    Robot,
    ShapeKind,
)
from .schema_cloud import Camera, Cloud
from .schema_motion import Motion, Seen
from .schema_over import Condition, Failure, Success
from .schema_planner import (
    EngineName,
    EngineSettings,
    Growing,
    Method,
    Noise,
    NoiseShape,
    NoiseSource,
    Planner,
    Refinement,
    Renewal,
    Risk,
    SampleCount,
    ShareOfRange,
    Solver,
    SplineKind,
    StepCount,
    Temperature,
)
from .schema_plant import Kick, PlantFactors, PlantNoise, PlantSettings
from .schema_random import Draw, Normal, Randomization, RandomizeTask, Rejection, Uniform
from .schema_sampling import Covariance, CovarianceForm, Execute, TryMean
from .types import (
    Count,
    Finite,
    Flag,
    Name,
    NonNegative,
    OneOrMore,
    Param,
    Positive,
    Quat,
    Section,
    Vec2or3,
)
from .waypoints import is_of, one_by_one

__all__ = [
    "AgentSettings",
    "Ancillary",
    "Camera",
    "Cloud",
    "Condition",
    "Cost",
    "Covariance",
    "CovarianceForm",
    "Draw",
    "Drive",
    "DriveMode",
    "EngineName",
    "EngineSettings",
    "Execute",
    "Failure",
    "Frame",
    "Goal",
    "Ground",
    "Growing",
    "Kick",
    "Method",
    "Motion",
    "Noise",
    "NoiseShape",
    "NoiseSource",
    "Normal",
    "Object",
    "Obstacle",
    "Phase",
    "Planner",
    "PlantFactors",
    "PlantNoise",
    "PlantSettings",
    "Pose",
    "Randomization",
    "RandomizeTask",
    "Refinement",
    "Rejection",
    "Renewal",
    "Risk",
    "Robot",
    "SafeCommand",
    "SampleCount",
    "Scene",
    "Seen",
    "ShapeKind",
    "ShareOfRange",
    "Solver",
    "SplineKind",
    "StepCount",
    "Success",
    "Target",
    "Temperature",
    "Timing",
    "TryMean",
    "Uniform",
]


class Timing(Section):
    """Time of the control loop."""

    control_dt: Positive = 0.04
    """Length of one planned control [s]."""
    timeout: Positive = 45.0
    """Simulated time after which a run counts as failed [s]."""


class Pose(Section):
    """A place, with or without an orientation."""

    position: Vec2or3 = (0.0, 0.0, 0.0)
    """(x, y) or (x, y, z) [m]; with two values the height does not matter."""
    yaw: Finite | None = None
    """Heading about z [rad]."""
    rotation: Quat | None = None
    """Full orientation (x, y, z, w) instead of a yaw."""

    @model_validator(mode="after")
    def _one_orientation(self) -> Pose:
        if self.yaw is not None and self.rotation is not None:
            raise ValueError("give yaw or rotation, not both")
        return self


class Target(Pose):
    """A named pose that may change between plans, a frame for cost terms: a waypoint, what a camera sees."""

    name: Name
    """What cost terms, conditions and ``task[...]`` call it."""


class Goal(Pose):
    """Where an object or a frame shall be."""

    object: str | None = None
    """Object that shall reach the goal."""
    frame: str | None = None
    """Robot frame (``robot/frame``) that shall reach the goal, instead of an object."""

    @model_validator(mode="after")
    def _one_target(self) -> Goal:
        if (self.object is None) == (self.frame is None):
            raise ValueError("a goal names either object or frame")
        return self

    @property
    def target(self) -> str:
        """Name of the frame that shall reach the goal."""
        return self.object or self.frame


class Cost(Section):
    """One cost term: its name, weight and the term's own keys (see ``warpmpc terms``)."""

    model_config = ConfigDict(extra="allow", frozen=True, use_attribute_docstrings=True)

    __pydantic_extra__: dict[str, Param]

    term: str
    """Which term: a built-in one, or one of yours from ``--terms``."""
    name: Name | None = None
    """What printouts and overrides call it; the term's name when left out."""
    weight: Finite = 1.0
    """Factor on its value; 0 switches it off."""
    terminal: NonNegative = 1.0
    """Factor on what it costs at the last step of the horizon, besides ``planner.terminal``."""

    @property
    def label(self) -> str:
        """Name in printouts and overrides."""
        return self.name or self.term

    @property
    def params(self) -> dict[str, Any]:
        """The term's own keys."""
        return dict(self.model_extra or {})


class Phase(Section):
    """A part of a task with targets, scalars and weights of its own; it ends when what it waits for has come."""

    name: Name
    """What ``--json`` and ``Monitor.phases`` call it."""
    goal: Pose | None = None
    """Where the goal is in this phase; where it was when left out."""
    through: Annotated[tuple[Pose, ...], OneOrMore] = ()
    """Goals one after the other in place of one; ``until``, ``hold`` and ``after`` hold for each, a phase NAME_1 ..."""
    count: Count | None = None
    """So many goals one after the other, as with ``through``, at one place: turned anew with ``draw_rotation``."""
    draw_rotation: Flag = False
    """Whether every episode draws the goal's orientation, of all there are, those of ``through`` and ``count`` too."""
    target: dict[Name, Pose] = Field(default_factory=dict)
    """Targets that are elsewhere in this phase."""
    scalar: dict[Name, Finite] = Field(default_factory=dict)
    """Scalars that have another value in this phase."""
    weight: dict[str, Finite] = Field(default_factory=dict)
    """Weights of cost terms in this phase; 0 switches a term off."""
    until: Annotated[tuple[Condition, ...], OneOrMore] = ()
    """The phase ends when all of these hold; the last phase has none and ends with the run."""
    hold: NonNegative = 0.0
    """... for this time [s]."""
    after: Positive | None = None
    """The phase ends after this time [s], whatever holds."""

    @model_validator(mode="after")
    def _one_kind_of_goal(self) -> Phase:
        given = [name for name in ("goal", "through") if getattr(self, name)]
        if len(given) == 2 or (self.through and self.count is not None):
            raise ValueError("a phase has a goal, with a count or without, or goes through several")
        if (self.count is not None or self.draw_rotation) and not given:
            raise ValueError("count and draw_rotation are about goals: give goal or through")
        if self.draw_rotation and any(pose.yaw is not None for pose in (self.goal, *self.through) if pose is not None):
            raise ValueError("draw_rotation takes the place of yaw")
        return self


class Scene(Section):
    """The whole content of a scene file."""

    title: str = ""
    """What happens in the scene, for lists and recordings."""
    timing: Timing = Timing()
    """Length of a control and of a run."""
    ground: Ground | None = Ground()
    """The floor; ``ground = false`` in a file leaves it out."""
    robot: tuple[Robot, ...] = Field(min_length=1)
    """Robots; the drives of all of them are planned for together."""
    object: tuple[Object, ...] = ()
    """Things that move freely."""
    obstacle: tuple[Obstacle, ...] = ()
    """Things that stay where they are, or where the task puts them."""
    cloud: tuple[Cloud, ...] = ()
    """Point clouds that are seen, values of the task."""
    goal: Goal | None = None
    """Where an object or a frame shall be; without one ``success`` has ``conditions`` alone."""
    target: tuple[Target, ...] = ()
    """Further named poses."""
    scalar: dict[Name, Finite] = Field(default_factory=dict)
    """Named numbers of the task that terms read and that may change between plans, such as a wanted speed."""
    phase: tuple[Phase, ...] = ()
    """Parts of the task, one after the other."""
    motion: tuple[Motion, ...] = ()
    """What moves by itself in a simulated plant."""
    cost: tuple[Cost, ...] = Field(min_length=1)
    """What the planner minimizes: the weighted sum of these terms over the steps of a rollout."""
    planner: Planner = Planner()
    """How plans are found."""
    engine: EngineSettings = EngineSettings()
    """The physics of the rollouts."""
    plant: PlantSettings = PlantSettings()
    """How the simulated plant differs from the planner's worlds."""
    agent: AgentSettings = AgentSettings()
    """How plans are followed in real time."""
    randomize: dict[str, Randomization] = Field(default_factory=dict)
    """Entity name → its random properties."""
    randomize_task: RandomizeTask = RandomizeTask()
    """What is drawn anew for every episode."""
    success: Success | None = None
    """When the run has reached what it wants; it goes on to ``timing.timeout`` and has a cost when left out."""
    failure: Annotated[tuple[Failure, ...], OneOrMore] = ()
    """What ends the run without success, each in a table."""
    path: Path | None = Field(None, exclude=True)
    """File the scene was read from; relative assets are found beside it."""
    variant: str | None = Field(None, exclude=True)
    """Variant that was applied."""

    @field_validator("planner")
    @classmethod
    def _with_horizon(cls, planner: Planner, info: ValidationInfo) -> Planner:
        if planner.horizon is not StepCount.AUTO or "timing" not in info.data:
            return planner
        return planner.model_copy(update={"horizon": planner.steps_ahead(info.data["timing"].control_dt)})

    @field_validator("phase")
    @classmethod
    def _one_goal_each(cls, phases: tuple[Phase, ...]) -> tuple[Phase, ...]:
        return one_by_one(phases)

    @field_validator("failure")
    @classmethod
    def _in_phases(cls, failures: tuple[Failure, ...], info: ValidationInfo) -> tuple[Failure, ...]:
        there = [phase.name for phase in info.data.get("phase", ())]
        for failure in failures:
            if failure.phase is not None and not any(is_of(name, failure.phase) for name in there):
                known = f"the phases are {', '.join(there)}" if there else "the scene has none"
                raise ValueError(f"'{failure.name}' is of no phase '{failure.phase}': {known}")
        return failures

    @property
    def flat_poses(self) -> set[str]:
        """The goal and the targets whose height does not matter, by name."""
        poses = {target.name: target for target in self.target}
        if self.goal is not None:
            poses["goal"] = self.goal
        return {name for name, pose in poses.items() if len(pose.position) == 2}

    @property
    def cost_labels(self) -> list[str]:
        """What the cost terms are called, with a number behind those that occur again."""
        seen: dict[str, int] = {}
        labels = []
        for cost in self.cost:
            seen[cost.label] = seen.get(cost.label, 0) + 1
            labels.append(cost.label if seen[cost.label] == 1 else f"{cost.label}_{seen[cost.label]}")
        return labels

    @property
    def judged_terms(self) -> set[str]:
        """Cost terms, by these names, that success, failures or ends of phases look at."""
        rows = [*self.success.conditions] if self.success else []
        rows += [condition for phase in self.phase for condition in phase.until]
        rows += [condition for failure in self.failure for condition in failure.conditions]
        return {condition.term for condition in rows if condition.term is not None}

    @property
    def name(self) -> str:
        """Short name: the file's, without its ending."""
        return self.path.stem if self.path else "scene"
