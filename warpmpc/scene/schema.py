# SPDX-License-Identifier: Apache-2.0
"""The types of a scene: what a scene file may say, and what Python may build instead.

Every type is frozen. Units are SI: metres, kilograms, seconds, radians, newtons. Quaternions are ``(x, y, z, w)``.
"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field, field_validator, model_validator

from .types import (
    Channel,
    Count,
    Finite,
    Flag,
    Floats,
    FloatsByName,
    Fraction,
    Name,
    Natural,
    NonNegative,
    NonNegatives,
    OneOrMore,
    Param,
    Positive,
    Positives,
    Quat,
    Section,
    Share,
    TwoOrMore,
    Vec2or3,
    Vec3,
)


class DriveMode(StrEnum):
    """What a control means to the joints it drives."""

    VELOCITY = "velocity"
    """Joint velocity targets [m/s or rad/s]."""
    POSITION = "position"
    """Joint position targets [m or rad]."""
    EFFORT = "effort"
    """Joint forces or torques [N or N·m]."""
    DIFF_DRIVE = "diff_drive"
    """Forward and turning speed (v [m/s], ω [rad/s]) of a base with a left and a right wheel."""


class ShapeKind(StrEnum):
    """Shapes of objects and obstacles."""

    BOX = "box"
    SPHERE = "sphere"
    CYLINDER = "cylinder"
    CAPSULE = "capsule"
    PLANE = "plane"
    MESH = "mesh"


class Method(StrEnum):
    """How costs become sample weights."""

    MPPI = "mppi"
    PREDICTIVE_SAMPLING = "predictive_sampling"
    CEM = "cem"


class Timing(Section):
    """Time of the control loop."""

    control_dt: Positive = 0.04
    """Length of one planned control [s]."""
    timeout: Positive = 45.0
    """Simulated time after which a run counts as failed [s]."""


class Frame(Section):
    """A named place on a robot link, such as a tool or a contact point."""

    link: str
    """Link (body) of the robot's asset the frame is fixed to."""
    offset: Vec3 = (0.0, 0.0, 0.0)
    """Position in the link's frame [m]."""
    rotation: Quat = (0.0, 0.0, 0.0, 1.0)
    """Orientation in the link's frame (x, y, z, w)."""


class Drive(Section):
    """What turns controls into motion of a group of joints."""

    mode: DriveMode = DriveMode.VELOCITY
    joints: tuple[str, ...] | None = None
    """Driven joints in control order; every joint that can move when left out. ``diff_drive``: (left, right) wheel."""
    stiffness: NonNegatives = (0.0,)
    """Position gain [N/m or N·m/rad], one value or one per joint. Used by ``position``."""
    damping: NonNegatives = (0.0,)
    """Velocity gain [N·s/m or N·m·s/rad], one value or one per joint. Used by ``velocity`` and ``position``."""
    effort_limit: Positives | None = None
    """Largest force or torque [N or N·m]; the asset's own limits when left out."""
    limit: Positives | None = None
    """Controls stay within ± this, one value or one per control."""
    lower: Floats | None = None
    """Lower bound of the controls where it is not ``-limit``."""
    upper: Floats | None = None
    """Upper bound of the controls where it is not ``limit``."""
    wheel_radius: Positive | None = None
    """``diff_drive``: radius of the wheels [m]."""
    track: Positive | None = None
    """``diff_drive``: distance between the wheels [m]."""

    @model_validator(mode="after")
    def _bounds(self) -> Drive:
        if self.limit is None and (self.lower is None or self.upper is None):
            raise ValueError("a drive needs limit = [...], or both lower = [...] and upper = [...]")
        if self.limit is not None and (self.lower is not None or self.upper is not None):
            raise ValueError("limit excludes lower and upper: give one or the other")
        if self.mode is DriveMode.DIFF_DRIVE:
            if self.wheel_radius is None or self.track is None:
                raise ValueError("mode 'diff_drive' needs wheel_radius and track")
            if self.joints is None or len(self.joints) != 2:
                raise ValueError("mode 'diff_drive' needs joints = [left, right]")
        if self.mode in (DriveMode.VELOCITY, DriveMode.DIFF_DRIVE) and not any(self.damping):
            raise ValueError(f"mode '{self.mode}' needs damping > 0: it is the gain of the velocity servo")
        if self.mode is DriveMode.POSITION and not any(self.stiffness):
            raise ValueError("mode 'position' needs stiffness > 0: it is the gain of the position servo")
        return self


class Robot(Section):
    """A robot from a URDF, MJCF or USD file."""

    name: Name
    asset: str
    """File relative to the scene file, absolute path, ``package://`` URI, or asset shipped with warpmpc."""
    position: Vec3 = (0.0, 0.0, 0.0)
    """Start position of the root [m]."""
    rotation: Quat = (0.0, 0.0, 0.0, 1.0)
    """Start orientation of the root (x, y, z, w)."""
    floating: Flag = False
    """Whether the root moves freely (legged robots, drones) or is fixed to the world."""
    joint_q: FloatsByName | None = None
    """Start joint coordinates in the asset's order, or by joint name; the asset's own when left out."""
    frames: dict[Name, Frame] = Field(default_factory=dict)
    drive: Annotated[tuple[Drive, ...], OneOrMore] = Field(min_length=1)
    """One drive or several, each with joints of its own; controls are stacked in this order."""
    self_collision: Flag = False
    """Whether links of this robot collide with each other."""
    friction: NonNegative | None = None
    """Friction of all its shapes; the asset's own when left out."""
    ground_contact: Flag = True
    """Whether its shapes touch planes; switch off for bases that glide on their joints."""
    armature: NonNegatives | None = None
    """Rotor inertia added to each driven joint [kg or kg·m²]; the asset's own when left out."""
    gravity_compensation: Flag = False
    """Whether gravity on its links is cancelled, as the controllers of most arms do."""


class _Shape(Section):
    name: Name
    shape: ShapeKind
    size: Positives | None = None
    """Box: full extents (x, y, z) [m]. Sphere: (radius). Cylinder: (radius, length along z).
    Capsule: (radius, length along z between the centres of its caps)."""
    mesh: str | None = None
    """Mesh file (STL, OBJ, PLY, ...), found like a robot's asset. Collides as its convex hull."""
    scale: Positive = 1.0
    """Factor from the mesh file's unit to metres."""
    friction: NonNegative = 1.0
    position: Vec3 = (0.0, 0.0, 0.0)
    """Position of the centre [m]."""
    rotation: Quat = (0.0, 0.0, 0.0, 1.0)
    color: tuple[Channel, Channel, Channel] | None = None
    """Colour in recordings, each channel in [0, 1]."""

    @model_validator(mode="after")
    def _dimensions(self) -> _Shape:
        need = {"box": 3, "sphere": 1, "cylinder": 2, "capsule": 2, "plane": 0, "mesh": 0}[self.shape]
        found = 0 if self.size is None else len(self.size)
        if found != need:
            what = {"box": "full extents [x, y, z]", "sphere": "[radius]"}.get(self.shape, "[radius, length]")
            wanted = f"size = {what}, {need} value{'s' * (need > 1)}" if need else "no size"
            raise ValueError(f"shape '{self.shape}' needs {wanted}; found {found}")
        if (self.mesh is not None) != (self.shape is ShapeKind.MESH):
            raise ValueError("mesh = \"file\" belongs to shape 'mesh', and to it alone")
        return self


class Object(_Shape):
    """A thing that moves freely: pushed, rolled, picked."""

    mass: Positive
    """Mass [kg]."""

    @field_validator("shape")
    @classmethod
    def _moves(cls, value: ShapeKind) -> ShapeKind:
        if value is ShapeKind.PLANE:
            raise ValueError("a plane cannot move: make it an obstacle")
        return value


class Obstacle(_Shape):
    """A thing that stays where it is."""


class Ground(Section):
    """The floor z = height."""

    friction: NonNegative = 1.0
    height: Finite = 0.0


class Goal(Section):
    """Where an object or a frame shall be."""

    object: str | None = None
    """Object that shall reach the goal."""
    frame: str | None = None
    """Robot frame (``robot/frame``) that shall reach the goal, instead of an object."""
    position: Vec2or3 = (0.0, 0.0, 0.0)
    """(x, y) or (x, y, z) [m]; with two values the height does not matter."""
    yaw: Finite | None = None
    """Heading about z [rad]."""
    rotation: Quat | None = None
    """Full orientation (x, y, z, w) instead of a yaw."""

    @model_validator(mode="after")
    def _one_target(self) -> Goal:
        if (self.object is None) == (self.frame is None):
            raise ValueError("a goal names either object or frame")
        if self.yaw is not None and self.rotation is not None:
            raise ValueError("a goal has yaw or rotation, not both")
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
    name: Name | None = None
    """What printouts and overrides call it; the term's name when left out."""
    weight: Finite = 1.0

    @property
    def label(self) -> str:
        """Name in printouts and overrides."""
        return self.name or self.term

    @property
    def params(self) -> dict[str, Any]:
        """The term's own keys."""
        return dict(self.model_extra or {})


class NoiseSource(StrEnum):
    """Where standard normals come from."""

    HALTON = "halton"
    SOBOL = "sobol"
    RANDOM = "random"


class NoiseShape(StrEnum):
    """How standard normals are correlated along the horizon."""

    IDENTITY = "identity"
    BSPLINE = "bspline"
    COMB = "comb"
    COLOURED = "coloured"


class Noise(Section):
    """Perturbation of the knots, ε = σ ⊙ (B z)."""

    source: NoiseSource = NoiseSource.HALTON
    shape: NoiseShape = NoiseShape.BSPLINE
    sigma: Positives = (0.5,)
    """Standard deviation in control units, one value or one per control."""
    spread: tuple[Positive, Positive] = (1.0, 1.0)
    """Factors (low, high) on sigma: samples run from one to the other, so that one batch searches near and far."""
    redraw: Flag = False
    """Fresh noise at every plan; when false it is drawn once, as in the papers."""
    comb: Vec3 = (0.3, 0.0, 0.7)
    """Coefficients of the comb filter (STORM)."""
    exponent: NonNegative = 1.0
    """Exponent α of coloured noise, power ∝ 1/f^α."""
    null_sample: Flag = True
    """Whether one sample is the zero control sequence."""


class Temperature(Section):
    """The inverse-exponential temperature β of MPPI."""

    initial: Positive = 1.0
    eta: tuple[Positive, Positive] | None = (5.0, 10.0)
    """Bounds of the effective number of samples η; β follows them between plans [P6]."""
    ess: Positive | None = None
    """Effective sample size (Σw)²/Σw² that β is solved for within each plan, instead of ``eta``."""

    @model_validator(mode="before")
    @classmethod
    def _ess_replaces_default_eta(cls, data: object) -> object:
        return {"eta": None, **data} if isinstance(data, dict) and data.get("ess") else data

    @model_validator(mode="after")
    def _ordered(self) -> Temperature:
        if self.eta is not None and self.ess is not None:
            raise ValueError("only one of eta and ess can steer the temperature: switch one off, as in eta = false")
        if self.eta is not None and self.eta[0] >= self.eta[1]:
            raise ValueError(f"eta = [low, high] needs low < high; found {list(self.eta)}")
        return self


class SplineKind(StrEnum):
    """How knots become controls."""

    ZERO = "zero"
    LINEAR = "linear"
    CUBIC = "cubic"
    BSPLINE = "bspline"


class Risk(StrEnum):
    """How the costs of one sample in several domains become one cost."""

    MEAN = "mean"
    WORST = "worst"
    CVAR = "cvar"


class Planner(Section):
    """The sampling-based planner."""

    method: Method = Method.MPPI
    samples: TwoOrMore = 256
    """Candidate control sequences S."""
    horizon: Count = 16
    """Steps T of a rollout."""
    dt: Positive | None = None
    """Length of one step of a rollout [s], ``timing.control_dt`` when left out. Longer steps look further ahead at the
    same price; they need a spline other than zero."""
    domains: Count = 1
    """Draws D of physical properties each sample is tried in; S·D rollouts. With 1, every sample has its own draw."""
    risk: Risk = Risk.MEAN
    cvar: Share = 0.25
    """Share of worst domains that ``risk = "cvar"`` averages."""
    knots: TwoOrMore | None = None
    """Spline control points P; one per step when left out."""
    spline: SplineKind = SplineKind.ZERO
    discount: Share = 0.95
    """Factor γ per control step [P5]."""
    noise: Noise = Noise()
    temperature: Temperature = Temperature()
    step_size: Share = 1.0
    """Step α of the mean towards the weighted samples [S4]."""
    iterations: Count = 1
    """Sample-roll-out-update rounds per plan."""
    elites: Count = 8
    """``cem``: best samples that carry weight."""
    sigma_min: NonNegatives = (0.01,)
    """``cem``: floor of the adapted standard deviation."""


class EngineName(StrEnum):
    """What rolls controls out."""

    AUTO = "auto"
    MUJOCO = "mujoco"


class Engine(Section):
    """The physics of the rollouts."""

    name: EngineName = EngineName.AUTO
    substeps: Count = 2
    """Physics steps per control."""
    threads: Natural = 0
    """CPU threads; 0 means one per core."""
    iterations: Count = 20
    """Largest number of constraint solver iterations."""
    tolerance: NonNegative = 1e-6
    """Constraint solver tolerance."""


class Kick(Section):
    """A shove: a sudden change of velocity of an object or of a robot's joints."""

    time: NonNegative
    """When [s]."""
    target: str
    """Object or robot."""
    velocity: Floats
    """Object: change of linear velocity (x, y, z) [m/s]. Robot: change of each joint velocity."""


class PlantNoise(Section):
    """Gaussian observation noise, as standard deviations."""

    position: NonNegative = 0.0
    """Joint positions and object positions [m or rad]."""
    velocity: NonNegative = 0.0
    """Velocities [m/s or rad/s]."""


class Plant(Section):
    """How the simulated plant differs from the planner's worlds."""

    substeps: Count = 8
    """Physics steps per control: finer than the planner's."""
    randomize: Flag = True
    """Whether the plant has randomized properties of its own, drawn like the rollouts'."""
    noise: PlantNoise = PlantNoise()
    delay: NonNegative = 0.0
    """Age of observations [s], rounded to whole controls."""
    kicks: tuple[Kick, ...] = ()


class Uniform(Section):
    """A fraction of the nominal value, uniform in ± ``uniform``."""

    uniform: Fraction


class Normal(Section):
    """A Gaussian with standard deviation ``normal``."""

    normal: NonNegative


class Randomization(Section):
    """Random physical properties of one robot, object or obstacle, drawn per world."""

    mass: Uniform | None = None
    friction: Uniform | None = None
    size: Normal | None = None
    """Added to each dimension [m]."""


class Draw(Section):
    """Uniform draw of a scene key at the start of an episode."""

    low: Floats
    high: Floats

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
    """Scene key (as in ``--set``, ``*`` for every name) → range."""
    reject: tuple[Rejection, ...] = ()


class Success(Section):
    """When the goal counts as reached."""

    position: Positive | None = None
    """Largest error along each axis [m]."""
    distance: Positive | None = None
    """Largest Euclidean error [m]."""
    yaw: Positive | None = None
    """Largest heading error [rad]."""
    rotation: Positive | None = None
    """Largest rotation angle to the goal orientation [rad]."""
    hold: NonNegative = 0.0
    """Time the errors must stay below [s]."""

    @model_validator(mode="after")
    def _something(self) -> Success:
        if self.position is None and self.distance is None and self.yaw is None and self.rotation is None:
            raise ValueError("success needs at least one of position, distance, yaw, rotation")
        return self


class Scene(Section):
    """The whole content of a scene file."""

    title: str = ""
    timing: Timing = Timing()
    ground: Ground | None = Ground()
    """The floor; ``ground = false`` in a file leaves it out."""
    robot: tuple[Robot, ...] = Field(min_length=1)
    object: tuple[Object, ...] = ()
    obstacle: tuple[Obstacle, ...] = ()
    goal: Goal
    cost: tuple[Cost, ...] = Field(min_length=1)
    planner: Planner = Planner()
    engine: Engine = Engine()
    plant: Plant = Plant()
    randomize: dict[str, Randomization] = Field(default_factory=dict)
    """Entity name → its random properties."""
    randomize_task: RandomizeTask = RandomizeTask()
    success: Success
    path: Path | None = Field(None, exclude=True)
    """File the scene was read from; relative assets are found beside it."""
    variant: str | None = Field(None, exclude=True)
    """Variant that was applied."""

    @property
    def name(self) -> str:
        """Short name: the file's, without its ending."""
        return self.path.stem if self.path else "scene"
