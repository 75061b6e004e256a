# SPDX-License-Identifier: Apache-2.0
"""The types of what stands in a scene: robots with their drives, objects, obstacles, the floor.

The types of point clouds in a scene, and of the camera that shows one to a simulated plant.
"""

from __future__ import annotations

import math
from enum import StrEnum
from typing import Annotated

from pydantic import Field, ValidationInfo, field_validator, model_validator

from .types import (
    Channel,
    Count,
    Finite,
    Flag,
    Floats,
    FloatsByName,
    Name,
    NonNegative,
    NonNegatives,
    OneOrMore,
    Positive,
    Positives,
    Quat,
    Section,
    TwoOrMore,
    Vec3,
)


class DriveMode(StrEnum):
    """Meaning of a control to the joints it drives."""

    VELOCITY = "velocity"
    """Joint velocity targets [m/s or rad/s]."""
    POSITION = "position"
    """Joint position targets [m or rad]."""
    ACCELERATION = "acceleration"
    """Joint accelerations [m/s² or rad/s²]: the target of a velocity servo runs at the pace that the control says."""
    EFFORT = "effort"
    """Joint forces or torques [N or N·m]."""
    DIFF_DRIVE = "diff_drive"
    """Forward and turning speed (v [m/s], ω [rad/s]) of a base with a left and a right wheel."""
    MOCAP = "mocap"
    """Speed of a mocap body of an MJCF file along the file's axes, and about them [m/s, rad/s]."""


class Turns(StrEnum):
    """Rotations of a driven mocap body."""

    NONE = "none"
    """It keeps the rotation that it starts with."""
    YAW = "yaw"
    """About the vertical."""
    ALL = "all"
    """About the vertical, then the turned y, then the turned x."""


class ShapeKind(StrEnum):
    """Shapes of objects and obstacles."""

    BOX = "box"
    SPHERE = "sphere"
    CYLINDER = "cylinder"
    CAPSULE = "capsule"
    PLANE = "plane"
    MESH = "mesh"


class Frame(Section):
    """A named place on a robot link, such as a tool or a contact point."""

    link: str
    """Link (body) of the robot's asset the frame is fixed to."""
    offset: Vec3 = (0.0, 0.0, 0.0)
    """Position in the link's frame [m]."""
    rotation: Quat = (0.0, 0.0, 0.0, 1.0)
    """Orientation in the link's frame (x, y, z, w)."""


class Drive(Section):
    """Drive that turns controls into motion of a group of joints."""

    mode: DriveMode = DriveMode.VELOCITY
    """What a control sets at the joints."""
    joints: tuple[str, ...] | None = None
    """Driven joints in the order of controls; all movable joints when left out. ``diff_drive``: (left, right) wheel."""
    stiffness: NonNegatives = (0.0,)
    """Position gain [N/m or N·m/rad], one value or one per joint. Used by ``position``."""
    damping: NonNegatives = (0.0,)
    """Velocity gain [N·s/m or N·m·s/rad], one value or one per joint. Used by all modes but ``effort``."""
    effort_limit: Positives | None = None
    """Largest force or torque [N or N·m]; as in the asset when left out."""
    limit: Positives | None = None
    """Controls stay within ± this, one value or one per control, in the unit of the ``mode``. When left out, limits of
    the asset's joints: speeds (``velocity``, ``diff_drive``), ranges (``position``) or efforts (``effort``)."""
    lower: Floats | None = None
    """Lower bound of the controls where it is not ``-limit``."""
    upper: Floats | None = None
    """Upper bound of the controls where it is not ``limit``."""
    speed_limit: Positives | None = None
    """``acceleration``: largest speed of the set point [m/s or rad/s]; as in the asset when left out."""
    wheel_radius: Positive | None = None
    """``diff_drive``: radius of the wheels [m]."""
    track: Positive | None = None
    """``diff_drive``: distance between the wheels [m]."""
    body: str | None = None
    """``mocap``: the mocap body; the only one when left out. It starts where its weld is not stretched."""
    within: tuple[Vec3, Vec3] | None = None
    """``mocap``: lowest and highest corner of the box that it stays in, in the file's coordinates [m]. Without a box it
    may move away from a hand that is blocked, which pulls harder."""
    rotation: Turns = Turns.NONE
    """``mocap``: rotations that are controls, after the three of the position."""

    @field_validator("stiffness", "damping", "effort_limit", "limit", "lower", "upper")
    @classmethod
    def _one_or_each(cls, values: tuple[float, ...] | None, info: ValidationInfo) -> tuple[float, ...] | None:
        joints = info.data.get("joints")
        if joints is not None and values is not None and len(values) not in (1, len(joints)):
            what = "controls" if info.data.get("mode") is DriveMode.DIFF_DRIVE else "joints"
            raise ValueError(f"needs 1 value, or {len(joints)}: one for each of its {what}")
        return values

    @model_validator(mode="after")
    def _bounds(self) -> Drive:
        if (self.lower is None) != (self.upper is None):
            raise ValueError("give both lower = [...] and upper = [...], or limit = [...], or none of them")
        if self.mode is DriveMode.ACCELERATION and self.limit is None and self.lower is None:
            raise ValueError("mode 'acceleration' needs limit = [...]: no asset says how fast its joints accelerate")
        if self.limit is not None and (self.lower is not None or self.upper is not None):
            raise ValueError("limit excludes lower and upper: give one or the other")
        if self.mode is DriveMode.DIFF_DRIVE:
            if self.wheel_radius is None or self.track is None:
                raise ValueError("mode 'diff_drive' needs wheel_radius and track")
            if self.joints is None or len(self.joints) != 2:
                raise ValueError("mode 'diff_drive' needs joints = [left, right]")
        if self.mode is DriveMode.MOCAP:
            if self.limit is None and self.lower is None:
                raise ValueError("mode 'mocap' needs limit = [...]: no asset says how fast a mocap body moves")
            if self.joints is not None:
                raise ValueError("mode 'mocap' moves a body, not joints: leave joints out, or take mode 'velocity'")
            if self.within and any(low >= high for low, high in zip(*self.within, strict=True)):
                raise ValueError("within is [lowest corner, highest corner]: each number below its counterpart")
        elif self.body is not None or self.within is not None or self.rotation is not Turns.NONE:
            raise ValueError("body, within and rotation belong to mode 'mocap'")
        if self.speed_limit is not None and self.mode is not DriveMode.ACCELERATION:
            raise ValueError("speed_limit belongs to mode 'acceleration'; velocities have limit = [...]")
        servo = (DriveMode.VELOCITY, DriveMode.DIFF_DRIVE, DriveMode.ACCELERATION)
        if self.mode in servo and not any(self.damping):
            raise ValueError(f"mode '{self.mode}' needs damping > 0: it is the gain of the velocity servo")
        if self.mode is DriveMode.POSITION and not any(self.stiffness):
            raise ValueError("mode 'position' needs stiffness > 0: it is the gain of the position servo")
        return self


class Robot(Section):
    """A robot from a URDF, MJCF or USD file.

    An MJCF file is simulated as it is written, with all its bodies, objects and floors; the keys below change it only
    where they are given.
    """

    name: Name
    """Name of the robot; its links, frames and joints are ``name/link`` and so on."""
    asset: str
    """File relative to the scene file, absolute path, ``package://`` URI, or asset shipped with warpmpc."""
    position: Vec3 | None = None
    """Start position of the root [m]; as in the asset when left out. MJCF: the root is the first body that moves, with
    its pose in ``keyframe``. Everything else in the file moves along, except planes and height fields that are fixed to
    the world."""
    rotation: Quat | None = None
    """Start orientation of the root (x, y, z, w); as in the asset when left out."""
    floating: Flag | None = None
    """Whether the root moves freely (legged robots, drones) or is fixed to the world. When left out, as in the MJCF
    file; URDF and USD roots are fixed."""
    keyframe: str | None = None
    """MJCF: keyframe to start in, with velocities, activations and controls; ``joint_q`` overrides its coordinates."""
    joint_q: FloatsByName | None = None
    """Start joint coordinates in the asset's order, or by joint name [m or rad]; as in the asset when left out. By
    name, a free joint takes a pose in the world, ``[x, y, z]`` or ``[x, y, z, qx, qy, qz, qw]``."""
    frames: dict[Name, Frame] = Field(default_factory=dict)
    """Named frames on its links: ``robot/frame`` in cost terms, goals and conditions."""
    drive: Annotated[tuple[Drive, ...], OneOrMore] = ()
    """One drive or several, each with its own joints; controls are stacked in this order. Without any, the actuators
    of an MJCF file are the controls; with one they are replaced, beside ``mocap`` alone they stay."""
    self_collision: Flag | None = None
    """Whether links of this robot collide with each other. When left out, as in the MJCF file (contype, conaffinity,
    exclude, pair); URDF and USD robots do not."""
    friction: NonNegative | None = None
    """Friction of all its shapes; as in the asset when left out."""
    ground_contact: Flag = True
    """Whether its shapes collide with planes; false for bases that slide on joints."""
    armature: NonNegatives | None = None
    """Rotor inertia of each driven joint [kg or kg·m²]; as in the asset when left out."""
    spheres: dict[str, tuple[tuple[Finite, Finite, Finite, Positive], ...]] = Field(default_factory=dict)
    """Link → spheres (x, y, z, radius) [m] in its frame for collision terms, in place of fitted ones; an empty list
    leaves the link out."""
    gravity_compensation: Flag = False
    """Whether gravity on its links is compensated, as controllers of most arms do."""

    @property
    def keeps_actuators(self) -> bool:
        """Return whether the actuators of its MJCF file are controls."""
        return all(drive.mode is DriveMode.MOCAP for drive in self.drive)

    @model_validator(mode="after")
    def _driven(self) -> Robot:
        if self.armature is not None and not self.drive:
            raise ValueError("armature is added to driven joints: it needs a drive")
        return self


SIZES = {"box": "[x, y, z]", "sphere": "[radius]", "cylinder": "[radius, length]", "capsule": "[radius, length]"}
"""Numbers of the sizes of shapes; a box has full extents."""


class _Shape(Section):
    name: Name
    """Name in the rest of the scene."""
    shape: ShapeKind
    """Geometry for contacts and drawing."""
    size: Positives | None = None
    """Box: full extents (x, y, z) [m]. Sphere: (radius). Cylinder: (radius, length along z).
    Capsule: (radius, length along z between the centres of its caps)."""
    mesh: str | None = None
    """Mesh file (STL, OBJ, PLY, ...), found like a robot's asset. Collides as its convex hull."""
    scale: Positive = 1.0
    """Factor from the mesh file's unit to metres."""
    friction: NonNegative = 1.0
    """Coefficient of sliding friction."""
    position: Vec3 = (0.0, 0.0, 0.0)
    """Position of the centre [m]."""
    rotation: Quat = (0.0, 0.0, 0.0, 1.0)
    """Orientation (x, y, z, w)."""
    color: tuple[Channel, Channel, Channel] | None = None
    """Colour in recordings, each channel in [0, 1]."""

    @model_validator(mode="before")
    @classmethod
    def _sized(cls, data: object) -> object:
        given = data if isinstance(data, dict) else {}
        wrong = [key for key in given if key in ("radius", "diameter", "length", "height", "width", "depth", "extents")]
        if wrong and (size := SIZES.get(str(given.get("shape")))):
            raise ValueError(f"unknown key {wrong[0]}: a {given['shape']} has size = {size}")
        return data

    @model_validator(mode="after")
    def _dimensions(self) -> _Shape:
        need = {"box": 3, "sphere": 1, "cylinder": 2, "capsule": 2, "plane": 0, "mesh": 0}[self.shape]
        found = 0 if self.size is None else len(self.size)
        if found != need:
            wanted = f"size = {SIZES[self.shape]}, {need} value{'s' * (need > 1)}" if need else "no size"
            raise ValueError(f"shape '{self.shape}' needs {wanted}; found {found}")
        if (self.mesh is not None) != (self.shape is ShapeKind.MESH):
            raise ValueError("mesh = \"file\" belongs to shape 'mesh', and to it alone")
        return self


class Object(_Shape):
    """An object that moves freely: pushed, rolled, picked."""

    mass: Positive
    """Mass [kg]."""
    inertia: tuple[Positive, Positive, Positive] | None = None
    """Moments of inertia about the shape's axes through its centre [kg·m²]; those of a solid body when left out."""
    linear_damping: NonNegative = 0.0
    """Rate c at which its velocity decays [1/s]: a force of -c times mass and velocity, integrated implicitly. PhysX
    scales velocities by 1 - c dt in every step, which is the same to first order. Draws of mass and size keep c."""
    angular_damping: NonNegative = 0.0
    """Rate at which its angular velocity decays [1/s], by a torque along its axes of inertia."""

    @field_validator("shape")
    @classmethod
    def _moves(cls, value: ShapeKind) -> ShapeKind:
        if value is ShapeKind.PLANE:
            raise ValueError("a plane cannot move: make it an obstacle")
        return value

    @model_validator(mode="after")
    def _damped(self) -> Object:
        if self.shape is ShapeKind.MESH and (self.linear_damping or self.angular_damping):
            raise ValueError("a mesh has no damping, since its axes are not those of its inertia: take another shape")
        return self


class Obstacle(_Shape):
    """An object that does not move, or that the task moves."""

    support: Flag = False
    """Whether objects lie on it, as on a table: geodesic paths and clearance terms of objects ignore it. False for what
    a mobile base has to drive around."""
    movable: Flag = False
    """Whether its pose is one of the task's, which may change between plans: ``task["name"] = pose``."""

    @model_validator(mode="after")
    def _moves(self) -> Obstacle:
        if self.movable and self.shape is ShapeKind.PLANE:
            raise ValueError("a plane cannot move: leave out movable, or make it a box")
        return self


class Ground(Section):
    """The floor z = height."""

    friction: NonNegative = 1.0
    """Coefficient of sliding friction."""
    height: Finite = 0.0
    """Position [m]."""


LONGEST = 1024
"""Voxels along an axis at most."""
DEEPEST = 100
"""Voxels in the reach at most."""


class Camera(Section):
    """A fixed depth camera in the plant's world."""

    position: Vec3
    """Position [m]."""
    look_at: Vec3
    """Point in the centre of the picture [m]."""
    width: TwoOrMore = 250
    """Pixels."""
    height: TwoOrMore = 200
    """Pixels."""
    fov: Annotated[float, Field(strict=True, gt=0.0, lt=170.0)] = 60.0
    """Vertical field of view [degrees]."""
    far: Positive = 3.0
    """Largest depth [m]."""
    rate: Positive = 30.0
    """Pictures per second [Hz]."""
    noise: NonNegative = 0.0
    """Standard deviation of the depth [m]."""

    @model_validator(mode="after")
    def _looks_somewhere(self) -> Camera:
        if self.position[:2] == self.look_at[:2]:
            raise ValueError("a camera that looks straight up or down has no upright picture: move it a little")
        return self


class Cloud(Section):
    """A point cloud [n, 3] that may change at every plan: ``task["name"] = points``."""

    name: Name
    """Name in cost terms and ``task[...]``."""
    low: Vec3
    """Lowest corner of the region in which points count [m]."""
    high: Vec3
    """Its highest corner [m]."""
    voxel: Positive = 0.025
    """Edge of the voxels [m]."""
    reach: Positive = 0.15
    """Largest distance that is computed [m], at least a link's radius plus a term's margin."""
    capacity: Annotated[Count, Field(le=10_000_000)] = 50000
    """Largest number of points."""
    eye: Vec3 | None = None
    """Where the points are seen from [m]; the camera's position when left out."""
    behind: NonNegative = 0.0
    """Depth behind a point, seen from the eye, that counts as occupied [m]: a picture shows front sides alone."""
    camera: Camera | None = None
    """Camera with which simulated plants fill the cloud; without it the controller does."""

    @property
    def size(self) -> tuple[int, int, int]:
        """Voxels along x, y, z that cover the region."""
        return tuple(max(math.ceil((b - a) / self.voxel - 1e-6), 2) for a, b in zip(self.low, self.high, strict=True))

    @property
    def seen_from(self) -> tuple[Finite, Finite, Finite] | None:
        """Place that the points are seen from [m]."""
        return self.eye or (self.camera.position if self.camera else None)

    @model_validator(mode="after")
    def _fits(self) -> Cloud:
        if any(a >= b for a, b in zip(self.low, self.high, strict=True)):
            raise ValueError("a cloud's region needs low = [x, y, z] below high = [x, y, z]")
        if max(self.size) > LONGEST:
            raise ValueError(f"a region of {self.size} voxels: at most {LONGEST} along an axis, take a larger voxel")
        if self.reach > DEEPEST * self.voxel:
            raise ValueError(f"a reach is {DEEPEST} voxels at most: take a larger voxel or a shorter reach")
        if self.behind and self.seen_from is None:
            raise ValueError("behind needs to know where the points are seen from: give eye = [x, y, z] or a camera")
        if self.camera and self.camera.width * self.camera.height > self.capacity:
            raise ValueError("the camera has more pixels than the cloud has capacity")
        return self
