# SPDX-License-Identifier: Apache-2.0
"""Lookups of a cost term in the scene while it is bound: frames, sensors, scalars, contact pairs, resources."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from ..kernels.cost.points import Wanted
from ..scene.errors import SceneError
from ..scene.model.assets import resolve_asset
from ..scene.model.pairs import Pair
from ..scene.schema import Cost
from ..scene.types import described
from .resources.geodesic import obstacle_outlines, polygon_distance
from .resources.resource import Resources

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from ..scene.model.layout import Entity, Layout, ShapeInfo
    from ..scene.schema import Scene

W = TypeVar("W")
PRIMITIVES = {"sphere": 0, "box": 1, "cylinder": 2, "capsule": 3, "plane": 4}
"""Numbers of the shapes whose distance ``kernels.cost.points.shape_distance`` knows."""


@dataclass
class Binding:
    """Collects what the terms of a scene need while they are bound one after the other."""

    scene: Scene
    layout: Layout
    device: str = "cpu"
    """Where the parameters of the terms live."""
    key: str = ""
    """Scene key of the term being bound, for errors."""
    pairs: list[Pair] = field(default_factory=list)
    sensors: list[str] = field(default_factory=list)
    """Names of the sensors that terms read, ``robot/sensor``."""
    kept: list[object] = field(default_factory=list)
    """Things that must live as long as the terms, such as meshes."""
    label: str = ""
    """Name of the term being bound."""
    memory: dict[str, int] = field(default_factory=dict)
    """How many numbers terms carry along the rollouts, by the name of the term."""

    def __post_init__(self):
        self.resources = Resources(self.scene, self.layout)

    def error(self, message: str, key: str = "", **more: Any) -> SceneError:
        """The error about the term being bound, or about one of its keys.

        Args:
            message: What is wrong.
            key: The key; the whole term when left out.
            more: What was ``found``, what is ``allowed``.
        """
        return SceneError(message, key=f"{self.key}.{key}" if key else self.key, file=self.file, **more)

    def unknown(self, key: str, own: Mapping[str, str | None]) -> SceneError:
        """The error about a key that neither the term, whose ``own`` keys have these meanings, nor every cost has."""
        common = {name: field.description for name, field in described(Cost).items()}
        return self.error("unknown key", key, found=key, allowed={**common, **own})

    def array(self, values: object, dtype: type) -> wp.array:
        """Array of parameters on the device of the terms; vectors, matrices and poses come from nested lists."""
        if hasattr(dtype, "_shape_"):
            scalar = np.int32 if dtype._wp_scalar_type_ is wp.int32 else np.float32
            values = np.asarray(values, dtype=scalar).reshape(-1, *dtype._shape_)
        return wp.array(values, dtype=dtype, device=self.device)

    def scalar(self, name: str, key: str) -> int:
        """Index of a scalar of the task."""
        names = list(self.scene.scalar)
        if name not in names:
            raise self.error("no such scalar", key, found=name, allowed=names)
        return names.index(name)

    def wanted(self, target: Sequence[float | str] | None, count: int, *, key: str = "target") -> Wanted:
        """Wanted values of a residual's numbers.

        Args:
            target: Numbers or names of scalars, one or one for each; zeros when None.
            count: How many numbers the residual has.
            key: What the scene file calls it, for errors.
        """
        target = self.spread((0.0,) if target is None else target, count, key)
        out = Wanted()
        out.scalar = self.array([self.scalar(x, key) if isinstance(x, str) else -1 for x in target], dtype=int)
        out.value = self.array([0.0 if isinstance(x, str) else x for x in target], dtype=float)
        return out

    def spread(self, values: Sequence, count: int, key: str) -> list:
        """One value for each of some joints, axes or numbers, from one for all or a list."""
        if len(values) not in (1, count):
            raise self.error(f"needs 1 or {count} values", key, found=list(values))
        return list(values) if len(values) == count else list(values) * count

    @property
    def file(self) -> Path | None:
        """Scene file, for errors."""
        return self.scene.path

    def frame(self, name: str, key: str) -> int:
        """Index of a frame."""
        return self._found(self.layout.frame, name, key)

    def robot(self, name: str, key: str) -> int:
        """Number of a robot or an object with mass."""
        bodies = {e.name: list(e.bodies) for e in self.layout.entities if e.kind in ("robot", "object")}
        allowed = [name for name, own in bodies.items() if self.layout.body_mass[own].sum() > 0.0]
        if name not in allowed:
            what = "no such robot or object with mass"
            raise self.error(what, key, found=name, allowed=allowed)
        return next(i for i, entity in enumerate(self.layout.entities) if entity.name == name)

    def joint(self, name: str, key: str) -> int:
        """Joint coordinate of a joint."""
        return self._found(self.layout.joint, name, key)

    def robots(self, of: str | None) -> list[Entity]:
        """The robot that a key ``of`` names; all robots when it is None."""
        robots = {entity.name: entity for entity in self.layout.entities if entity.kind == "robot"}
        if of is not None and of not in robots:
            raise self.error("no such robot", "of", found=of, allowed=robots)
        return list(robots.values()) if of is None else [robots[of]]

    def only_robot(self, of: str | None) -> Entity:
        """The robot that a key ``of`` names, or the only one when it is None."""
        found = self.robots(of)
        if len(found) != 1:
            raise self.error("several robots: name one", "of", allowed=[robot.name for robot in found])
        return found[0]

    def weights(self, file: str, load: Callable[[Path], W]) -> W:
        """Trained weights that the key ``weights`` names, beside the scene or in its assets.

        Args:
            file: Name of the file.
            load: Reads it; raises OSError or ValueError where it is no such file.
        """
        base = None if self.file is None else self.file.parent
        path = resolve_asset(file, base=base, key=f"{self.key}.weights", file=self.file)
        try:
            return load(path)
        except (OSError, ValueError) as error:
            raise self.error(f"cannot be read as weights: {error}", "weights", found=file) from error

    def owned(self, of: str | None, names: Sequence[str]) -> range:
        """Indices of the names that belong to a robot; of all when it is None."""
        self.robots(of)
        own = [i for i, name in enumerate(names) if of is None or name.startswith(f"{of}/")]
        return range(own[0], own[-1] + 1) if own else range(0)

    @property
    def dof_joints(self) -> list[str]:
        """Name of the joint that each degree of freedom belongs to."""
        counts = self.layout.joint_dof_dim.sum(axis=1)
        return [name for name, count in zip(self.layout.joint_name, counts, strict=True) for _ in range(count)]

    def dofs(self, of: str | None, joints: Sequence[str] | None) -> list[int]:
        """Degrees of freedom of joints by name, or of a robot: of the first when both are None."""
        if joints is None:
            return list(self.owned(of or self.robots(None)[0].name, self.dof_joints))
        if of is not None:
            what = "name joints or their robot, not both: leave out 'of'"
            raise self.error(what, "joints", found=of)
        coords = [self.joint(name, "joints") for name in joints]
        if len(set(coords)) < len(coords):
            raise self.error("a joint is named twice", "joints", found=list(joints))
        return [int(np.flatnonzero(self.layout.dof_coord == coord)[0]) for coord in coords]

    def carry(self, count: int) -> int:
        """First of the numbers that the term being bound carries along the rollouts.

        Args:
            count: How many they are.
        """
        first = sum(self.memory.values())
        self.memory[self.label] = count
        return first

    def carried(self, name: str, key: str) -> int:
        """First of the numbers that a term above this one carries along."""
        if name not in self.memory:
            raise self.error(
                "no cost term above this one carries numbers along under this name",
                key,
                found=name,
                allowed=self.memory,
            )
        names = list(self.memory)
        return sum(self.memory[other] for other in names[: names.index(name)])

    def sensor(self, name: str, key: str) -> int:
        """Index of a sensor's first number; from now on the rollouts record this sensor.

        Raises:
            SceneError: If there is none, or several.
        """
        start = self._found(self.layout.sensor, name, key)
        self.sensors.append(self.layout.sensor_name[self.layout.sensor_start.tolist().index(start)])
        return start

    def _found(self, look_up: Callable[[str], int], name: str, key: str) -> int:
        try:
            return look_up(name)
        except SceneError as error:
            raise self.error(error.message, key, found=name, allowed=error.allowed) from None

    def control(self, name: str, key: str) -> int:
        """Index of a control.

        Raises:
            SceneError: If there is none.
        """
        names = self.layout.control_name
        if name not in names:
            raise self.error("no such control", key, found=name, allowed=names)
        return names.index(name)

    def watch(self, first: str, second: str, key: str) -> tuple[int, int]:
        """Watch the contact forces between two entities or groups; returns (first pair, count)."""
        try:
            sides = [self.layout.group(name) for name in (first, second)]
        except SceneError as error:
            raise self.error(error.message, key, found=error.found, allowed=error.allowed) from None
        if first == second and len(sides[0]) == 1:
            raise self.error("contact takes two different things", key, found=[first, second])
        wanted = [Pair(a.name, b.name) for a in sides[0] for b in sides[1] if a.name != b.name]
        start = len(self.pairs)
        self.pairs.extend(wanted)
        return start, len(wanted)

    def object_shape(self, name: str, key: str) -> ShapeInfo:
        """The first shape of an object, a primitive."""
        objects = {e.name: e for e in self.layout.entities if e.kind == "object"}
        if name not in objects:
            raise self.error("no such object", key, found=name, allowed=objects)
        shape = self.layout.shapes[objects[name].shapes[0]]
        if shape.kind not in PRIMITIVES:
            raise self.error("an outline needs a primitive shape", key, found=shape.kind)
        return shape

    def require_still(self, key: str = "") -> None:
        """For terms that know obstacles only where they are at the start.

        Raises:
            SceneError: If an obstacle moves with the task.
        """
        if self.layout.movable:
            raise self.error(
                "this term does not follow obstacles that move with the task: take world_collision, or leave out "
                f"movable of obstacle '{self.layout.movable[0]}'",
                key,
            )

    @property
    def supports(self) -> set[str]:
        """Obstacles that objects lie on."""
        return {obstacle.name for obstacle in self.scene.obstacle if obstacle.support}

    def require_way(self, name: str) -> None:
        """An object to be pushed starts upright, and nothing but supports may be where it starts or where its goal is.

        Raises:
            SceneError: If it is tilted and no sphere, or its centre or goal is within an obstacle's outline.
        """
        pushed = next(o for o in self.scene.object if o.name == name)
        height = Rotation.from_quat(pushed.rotation).apply([0.0, 0.0, 1.0])[2]
        if pushed.shape != "sphere" and height < 0.99:
            raise SceneError(
                "push_path takes an object that stands upright: give its size for that",
                key=f"object.{name}.rotation",
                file=self.file,
                found=pushed.rotation,
            )
        places = {f"'{name}' starts": pushed.position[:2]}
        if self.scene.goal is not None and self.scene.goal.object == name:
            places[f"the goal of '{name}' lies"] = self.scene.goal.position[:2]
        for obstacle, corners in obstacle_outlines(self.layout, self.supports):
            for what, place in places.items():
                if polygon_distance(np.array(place), corners) < 0.0:
                    raise SceneError(
                        f"seen from above, {what} within obstacle '{obstacle}', so that push_path finds no way; if it "
                        "is what the object lies on, give that obstacle support = true",
                        key=f"obstacle.{obstacle}.support",
                        file=self.file,
                    )

    def footprint(self, name: str) -> float:
        """Radius [m] that obstacles grow by for a mover: between its footprint's inner and outer circle."""
        entity = self.layout.entity(name.split("/")[0])
        inner, outer = 0.0, 0.0
        for i in entity.shapes:
            shape = self.layout.shapes[i]
            if not shape.collides or shape.kind in ("plane", "mesh"):
                continue
            x, y = (shape.scale[0], shape.scale[1] if shape.kind == "box" else shape.scale[0])
            inner = max(inner, min(x, y))
            outer = max(outer, (x * x + y * y) ** 0.5 if shape.kind == "box" else x)
        return 0.5 * (inner + outer)
