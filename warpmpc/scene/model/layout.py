# SPDX-License-Identifier: Apache-2.0
"""The layout of a scene's state: which number belongs to which joint, body, shape and control of one world."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, fields, replace
from typing import TYPE_CHECKING

import numpy as np

from ..errors import UnknownName

if TYPE_CHECKING:
    from pathlib import Path

WORLD = -1
"""Body index of everything that is fixed to the world."""
GOAL = -2
"""Body index of the frame ``goal``, whose pose is an input of every plan."""

IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Entity:
    """A robot, object, obstacle or the ground: a name and what belongs to it."""

    name: str
    kind: str
    """``robot``, ``object``, ``obstacle`` or ``ground``."""
    bodies: tuple[int, ...] = ()
    """Its bodies, root first; empty when it is fixed to the world."""
    shapes: tuple[int, ...] = ()
    joints: tuple[int, ...] = ()
    movable: bool = False
    """An obstacle whose pose is one of the task's."""
    damping: tuple[float, float] = (0.0, 0.0)
    """Rates at which an object's velocity and angular velocity decay [1/s]."""


@dataclass(frozen=True)
class ShapeInfo:
    """One shape as recordings and distance fields need it."""

    name: str
    entity: str
    body: int
    kind: str
    """``box``, ``sphere``, ``cylinder``, ``capsule``, ``plane``, ``ellipsoid``, ``cone`` or ``mesh``."""
    pose: tuple[float, ...]
    """Pose in its body's frame (x, y, z, qx, qy, qz, qw)."""
    scale: tuple[float, float, float]
    """Half extents, or (radius, half length), or a mesh's scale."""
    collides: bool = True
    visible: bool = True
    color: tuple[float, float, float] | None = None
    mesh: int | None = None
    """Index into :attr:`Layout.meshes`."""


@dataclass(frozen=True)
class Keyframe:
    """A state that an asset gives a name; where the asset says nothing, the start of the scene."""

    name: str
    """``robot/key``."""
    joint_q: tuple[float, ...]
    joint_qd: tuple[float, ...]
    act: tuple[float, ...]
    control: tuple[float, ...]
    mocap: tuple[float, ...] = ()
    """Poses of mocap bodies, one after the other."""


def accelerator(dof: int) -> str:
    """Name of the actuator that accelerates a joint velocity."""
    return f"accelerate_{dof}"


def _no_floats() -> np.ndarray:
    return np.zeros(0, dtype=np.float32)


def _no_indices() -> np.ndarray:
    return np.zeros(0, dtype=np.int32)


def rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Vectors ``[..., 3]`` turned by quaternions ``[..., 4]`` (x, y, z, w)."""
    u, w = q[..., :3], q[..., 3:]
    return v + 2.0 * np.cross(u, np.cross(u, v) + w * v)


@dataclass(frozen=True)
class Layout:
    """State layout of one world; index arrays are int32, poses ``(x, y, z, qx, qy, qz, qw)``, in Newton's conventions.

    ``nq`` joint coordinates, ``nv`` joint velocities, ``nb`` bodies, ``nj`` joints, ``nu`` controls, ``nd`` actuators
    of drives, ``na`` activations, ``nm`` mocap bodies, ``ns`` numbers that sensors show.
    """

    # joints, in the order forward kinematics visits them
    joint_name: tuple[str, ...]
    joint_type: np.ndarray  # [nj] newton.JointType
    joint_parent: np.ndarray  # [nj] body or -1
    joint_child: np.ndarray  # [nj] body
    joint_q_start: np.ndarray  # [nj]
    joint_qd_start: np.ndarray  # [nj]
    joint_dof_dim: np.ndarray  # [nj, 2] linear, angular axes
    joint_pose_parent: np.ndarray  # [nj, 7]
    joint_pose_child: np.ndarray  # [nj, 7]
    dof_axis: np.ndarray  # [nv, 3]
    dof_lower: np.ndarray  # [nv]
    dof_upper: np.ndarray  # [nv]
    dof_speed: np.ndarray  # [nv] greatest velocity by the asset [m/s or rad/s], 1e6 where it says nothing
    dof_coord: np.ndarray  # [nv] joint coordinate of a dof, -1 for those of free and ball joints
    dof_name: tuple[str, ...]  # [nv] robot/axis, empty for those of free and ball joints
    body_name: tuple[str, ...]
    body_com: np.ndarray  # [nb, 3]
    body_mass: np.ndarray  # [nb] [kg]
    body_inertia: np.ndarray  # [nb, 3, 3] about the centre of mass, along the body's axes [kg m²]
    joint_q: np.ndarray  # [nq] start
    joint_qd: np.ndarray  # [nv] start
    # controls
    control_name: tuple[str, ...]
    control_lower: np.ndarray  # [nu]
    control_upper: np.ndarray  # [nu]
    control_safe: np.ndarray  # [nu] joint coordinate to hold, or -1: the safe command is zero
    control_brake: np.ndarray  # [nu] joint velocity that an acceleration changes, or -1: the safe command brakes it
    actuator_dof: np.ndarray  # [nd]
    actuator_mode: tuple[str, ...]  # [nd] velocity, position, acceleration or effort
    actuator_matrix: np.ndarray  # [nd, nu] actuator target = matrix · control + offset
    actuator_offset: np.ndarray  # [nd]
    actuator_effort: np.ndarray  # [nd] effort limit
    actuator_damping: np.ndarray  # [nd] gain of the velocity
    actuator_speed: np.ndarray  # [nd] speed limit of the joint
    # names
    entities: tuple[Entity, ...]
    shapes: tuple[ShapeInfo, ...]
    frame_name: tuple[str, ...]
    frame_body: np.ndarray  # [nf] body, WORLD or GOAL
    frame_pose: np.ndarray  # [nf, 7] in the body's frame
    meshes: tuple[tuple[np.ndarray, np.ndarray], ...] = field(default=(), repr=False)
    """Vertices [n, 3] and triangles [m, 3] of each distinct mesh."""
    # what an asset may bring beyond joints and bodies
    control_start: np.ndarray = field(default_factory=_no_floats)  # [nu] that holds the start; may be empty
    activation_name: tuple[str, ...] = ()  # [na] robot/actuator
    act: np.ndarray = field(default_factory=_no_floats)  # [na] start
    mocap_name: tuple[str, ...] = ()  # [nm] robot/body
    mocap_body: np.ndarray = field(default_factory=_no_indices)  # [nm]
    mocap: np.ndarray = field(
        default_factory=lambda: np.zeros((0, 7), dtype=np.float32)
    )  # [nm, 7] start pose in the world's frame
    sensor_name: tuple[str, ...] = ()  # robot/sensor
    sensor_start: np.ndarray = field(default_factory=_no_indices)  # first of the sensor's numbers among the ns of all
    sensor_dim: np.ndarray = field(default_factory=_no_indices)  # how many numbers the sensor shows
    keyframes: tuple[Keyframe, ...] = ()
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)  # [m/s²]

    @property
    def nq(self) -> int:
        """Number of joint coordinates."""
        return len(self.joint_q)

    @property
    def nv(self) -> int:
        """Number of joint velocities."""
        return len(self.joint_qd)

    @property
    def nb(self) -> int:
        """Number of bodies."""
        return len(self.body_name)

    @property
    def nu(self) -> int:
        """Number of controls."""
        return len(self.control_name)

    @property
    def na(self) -> int:
        """Number of activations: the states of actuators that have their own dynamics."""
        return len(self.act)

    @property
    def activation_speed(self) -> np.ndarray:
        """Joint velocity whose set point an activation is ``[na]``, -1 for activations of MJCF files."""
        driven = {accelerator(dof): dof for dof in self.actuator_dof}
        return np.array([driven.get(name, -1) for name in self.activation_name], dtype=np.int32)

    @property
    def nm(self) -> int:
        """Number of mocap bodies: moved by observations, not by the physics."""
        return len(self.mocap_name)

    @property
    def movable(self) -> tuple[str, ...]:
        """Obstacles that move with the task, the last of its poses in this order."""
        return tuple(entity.name for entity in self.entities if entity.movable)

    @property
    def ns(self) -> int:
        """Number of numbers that all sensors show together."""
        return int(self.sensor_dim.sum())

    def entity(self, name: str, *, key: str = "") -> Entity:
        """The robot, object, obstacle or ground of this name.

        Raises:
            UnknownName: If there is none.
        """
        for entity in self.entities:
            if entity.name == name:
                return entity
        raise UnknownName("no such entity", key=key, found=name, allowed=[e.name for e in self.entities])

    def group(self, name: str, *, key: str = "") -> tuple[Entity, ...]:
        """The entity of this name, or all ``obstacles``, ``objects`` or ``robots``.

        Raises:
            UnknownName: If there is no such entity or group.
        """
        groups = {"obstacles": "obstacle", "objects": "object", "robots": "robot"}
        if name in groups:
            return tuple(e for e in self.entities if e.kind == groups[name])
        try:
            return (self.entity(name),)
        except UnknownName:
            allowed = [e.name for e in self.entities] + list(groups)
            raise UnknownName("no such entity", key=key, found=name, allowed=allowed) from None

    def frame(self, name: str, *, key: str = "") -> int:
        """Index of a frame: ``robot/frame``, ``robot/link``, an object, an obstacle or ``goal``.

        Raises:
            UnknownName: If there is none.
        """
        if name in self.frame_name:
            return self.frame_name.index(name)
        raise UnknownName("no such frame", key=key, found=name, allowed=self.frame_name)

    def joint(self, name: str, *, key: str = "") -> int:
        """Joint coordinate index of a joint axis, ``robot/joint`` or the joint's own name where unique.

        Raises:
            UnknownName: If there is none, or several.
        """
        axes = [i for i, axis in enumerate(self.dof_name) if axis]
        found = [i for i in axes if name in (self.dof_name[i], self.dof_name[i].split("/")[-1])]
        if len(found) != 1:
            what = "several joints have this name" if found else "no such joint"
            raise UnknownName(what, key=key, found=name, allowed=[self.dof_name[i] for i in axes])
        return int(self.dof_coord[found[0]])

    def sensor(self, name: str, *, key: str = "") -> int:
        """Index of the first number of a sensor, ``robot/sensor`` or the sensor's own name where unique.

        Raises:
            UnknownName: If there is none, or several.
        """
        found = [i for i, full in enumerate(self.sensor_name) if name in (full, full.partition("/")[2])]
        if len(found) != 1:
            what = "several sensors have this name" if found else "no such sensor"
            raise UnknownName(what, key=key, found=name, allowed=self.sensor_name)
        return int(self.sensor_start[found[0]])

    def save(self, path: Path) -> None:
        """Write the layout to an ``.npz`` file."""
        arrays, meta = {}, {}
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, np.ndarray):
                arrays[item.name] = value
            elif item.name == "meshes":
                for i, (points, triangles) in enumerate(value):
                    arrays[f"mesh{i}_points"], arrays[f"mesh{i}_triangles"] = points, triangles
            elif item.name in _RECORDS:
                meta[item.name] = [asdict(entry) for entry in value]
            else:
                meta[item.name] = value
        np.savez(path, meta=json.dumps(meta), **arrays)

    @classmethod
    def load(cls, path: Path) -> Layout:
        """Read what :meth:`save` wrote."""
        with np.load(path) as data:
            meta = json.loads(str(data["meta"]))
            values = {name: data[name] for name in data.files if name != "meta" and not name.startswith("mesh")}
            count = sum(name.endswith("_points") for name in data.files)
            values["meshes"] = tuple((data[f"mesh{i}_points"], data[f"mesh{i}_triangles"]) for i in range(count))
        for name, record in _RECORDS.items():
            values[name] = tuple(record(**{k: _tuple(v) for k, v in entry.items()}) for entry in meta.pop(name))
        return cls(**values, **{k: _tuple(v) for k, v in meta.items()})

    def replace(self, **changes: object) -> Layout:
        """A copy with some fields changed."""
        return replace(self, **changes)


_RECORDS = {"entities": Entity, "shapes": ShapeInfo, "keyframes": Keyframe}
"""Fields of a layout that hold records, and their type."""


def _tuple(value: object) -> object:
    return tuple(value) if isinstance(value, list) else value
