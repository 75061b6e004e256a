# SPDX-License-Identifier: Apache-2.0
"""The types of a scene: what a scene file may say, and what Python may build instead.

Every type is frozen. Units are SI: metres, kilograms, seconds, radians, newtons. Quaternions are ``(x, y, z, w)``.
"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field, ValidationInfo, field_validator

from .schema_bodies import Camera, Cloud, Drive, DriveMode, Frame, Ground, Object, Obstacle, Robot, ShapeKind
from .schema_estimate import (
    Estimate,
    EstimateBase,
    ImuNoise,
    ImuSensor,
    JointNoise,
    JointSensor,
    MeasurementNoise,
    PoseError,
    PoseModel,
    PoseSensor,
    ProcessNoise,
    Sensors,
    StartNoise,
)
from .schema_goal import Condition, Failure, Goal, Phase, Pose, Success, Target, is_of, one_by_one
from .schema_planner import (
    AgentSettings,
    Growing,
    Method,
    Planner,
    Refinement,
    Risk,
    SafeCommand,
    SampleCount,
    SplineKind,
    StepCount,
)
from .schema_plant import (
    Draw,
    EngineName,
    EngineSettings,
    FrictionCombine,
    Kick,
    Motion,
    Normal,
    PlantFactors,
    PlantNoise,
    PlantSettings,
    Randomization,
    RandomizeTask,
    Rejection,
    Seen,
    Solver,
    Uniform,
)
from .schema_sampling import (
    Ancillary,
    Covariance,
    CovarianceForm,
    Execute,
    Noise,
    NoiseShape,
    NoiseSource,
    Renewal,
    ShareOfRange,
    Temperature,
    TryMean,
)
from .types import Finite, Name, NonNegative, OneOrMore, Param, Positive, Section

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
    "Estimate",
    "EstimateBase",
    "Execute",
    "Failure",
    "Frame",
    "Goal",
    "Ground",
    "Growing",
    "ImuNoise",
    "ImuSensor",
    "JointNoise",
    "JointSensor",
    "Kick",
    "MeasurementNoise",
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
    "PoseError",
    "PoseModel",
    "PoseSensor",
    "ProcessNoise",
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
    "Sensors",
    "ShapeKind",
    "ShareOfRange",
    "Solver",
    "SplineKind",
    "StartNoise",
    "StepCount",
    "Success",
    "Target",
    "Temperature",
    "Timing",
    "TryMean",
    "Uniform",
    "When",
]


class Timing(Section):
    """Time of the control loop."""

    control_dt: Positive = 0.04
    """Length of one planned control [s]."""
    timeout: Positive = 45.0
    """Simulated time after which a run counts as failed [s]."""

    @field_validator("timeout")
    @classmethod
    def _one_control(cls, timeout: float, info: ValidationInfo) -> float:
        if timeout < (control_dt := info.data.get("control_dt", 0.0)):
            raise ValueError(f"is shorter than timing.control_dt = {control_dt:g}")
        return timeout


class When(StrEnum):
    """Steps of the horizon at which a cost term counts."""

    STAGE = "stage"
    """All, but the last one where a scene has terminal terms."""
    TERMINAL = "terminal"
    """The last one."""


class Cost(Section):
    """One cost term: its name, weight and the term's own keys (see ``warpmpc terms``)."""

    model_config = ConfigDict(extra="allow", frozen=True)

    __pydantic_extra__: dict[str, Param]

    term: str
    """Which term: a built-in one, or one of yours from ``--terms``."""
    name: Name | None = None
    """Name in tables and overrides; the term's name when left out."""
    weight: NonNegative = 1.0
    """Factor on its value; 0 switches it off."""
    terminal: NonNegative = 1.0
    """Factor on its cost at the last step of the horizon, in addition to ``planner.terminal``."""
    when: When = When.STAGE
    """Steps at which it counts. If any term with a weight is ``terminal``, these terms alone make the cost of the last
    step [S2], and the key ``terminal`` of the others has no effect."""

    @property
    def label(self) -> str:
        """Name in printouts and overrides."""
        return self.name or self.term

    @property
    def params(self) -> dict[str, Any]:
        """The term's own keys."""
        return dict(self.model_extra or {})


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
    randomize: dict[str, Randomization] = Field(default_factory=dict)
    """Entity name → its random properties."""
    engine: EngineSettings = EngineSettings()
    """The physics of the rollouts."""
    plant: PlantSettings = PlantSettings()
    """How the simulated plant differs from the planner's worlds."""
    estimate: dict[str, Estimate] = Field(default_factory=dict)
    """Object, or robot with a free root → how its pose and velocity are estimated from measured poses. Something that a
    sensor measures and that is not here is where it was measured last, with the velocity between the last two."""
    estimate_base: dict[str, EstimateBase] = Field(default_factory=dict)
    """Robot with a free root → how its root is estimated from an inertial measurement unit, joints and contact."""
    agent: AgentSettings = AgentSettings()
    """How plans are followed in real time."""
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
        return planner.with_horizon(info.data["timing"].control_dt) if "timing" in info.data else planner

    @field_validator("engine")
    @classmethod
    def _with_every_draw(cls, engine: EngineSettings, info: ValidationInfo) -> EngineSettings:
        drawn = [name for name, random in info.data.get("randomize", {}).items() if random.friction is not None]
        objects = [item.name for item in info.data.get("object", ())]
        if engine.friction_combine is not None or not drawn or (drawn == objects[:1] and len(objects) == 1):
            return engine
        return engine.model_copy(update={"friction_combine": FrictionCombine.AVERAGE})

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
        """Names of the cost terms, with a number behind those that occur again, which files may not have."""
        seen: dict[str, int] = {}
        labels = []
        for cost in self.cost:
            seen[cost.label] = seen.get(cost.label, 0) + 1
            labels.append(cost.label if seen[cost.label] == 1 else f"{cost.label}_{seen[cost.label]}")
        return labels

    @property
    def watched_terms(self) -> set[str]:
        """Cost terms, by these names, that success, failures or ends of phases look at."""
        rows = [*self.success.conditions] if self.success else []
        rows += [condition for phase in self.phase for condition in phase.until]
        rows += [condition for failure in self.failure for condition in failure.conditions]
        return {condition.term for condition in rows if condition.term is not None}

    @property
    def name(self) -> str:
        """Short name: the file's, without its ending."""
        return self.path.stem if self.path else "scene"
