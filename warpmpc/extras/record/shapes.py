# SPDX-License-Identifier: Apache-2.0
"""The shapes of a scene that are drawn, and where they are.

Shapes of a scene as triangles.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import trimesh

from ...scene.model.layout import IDENTITY, WORLD, rotate

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ...loop.plant.plant import Plant
    from ...scene.model.layout import Entity, Layout, ShapeInfo
    from ...scene.model.properties import Properties
    from ...scene.schema_bodies import Cloud

GROUND_COLOR = (0.32, 0.34, 0.37)
DEFAULT_COLOR = (0.7, 0.7, 0.7)
GHOST = 0.35
"""Opacity of the goal."""
FORCE_LENGTH = 0.005
"""Length of a force's arrow [m/N]."""
FORCE_LENGTH_MAX = 1.0
"""Longest arrow [m]."""
FORCE_COLOR = (255, 140, 0)


def shown_shapes(layout: Layout, entity: Entity) -> tuple[ShapeInfo, ...]:
    """Shapes to draw of an entity: of each body the asset's visuals where it has them, else its collision shapes."""
    shapes = tuple(layout.shapes[i] for i in entity.shapes)
    dressed = {shape.body for shape in shapes if shape.visible}
    return tuple(s for s in shapes if s.visible or (s.collides and s.body not in dressed))


def resized(shape: ShapeInfo, properties: Properties | None) -> ShapeInfo:
    """The shape with the plant's own randomized size; meshes and planes keep theirs."""
    if properties is None or shape.entity not in properties.names or shape.kind in ("mesh", "plane"):
        return shape
    offset = properties.size[0, properties.names.index(shape.entity)]
    share = {"box": (0.5, 0.5, 0.5), "sphere": (1.0, 0.0, 0.0)}.get(shape.kind, (1.0, 0.5, 0.0))
    scale = np.array(shape.scale)
    return replace(shape, scale=tuple(np.maximum(scale + np.array(share) * offset, 0.1 * scale)))


def drawn_shapes(plant: Plant, entity: Entity) -> Iterator[ShapeInfo]:
    """Shapes of a plant's entity as it is, in the plant's own sizes; those of a movable one are about its origin."""
    for shape in shown_shapes(plant.layout, entity):
        shape = shape if entity.kind == "robot" else resized(shape, plant.properties)
        yield replace(shape, pose=IDENTITY) if entity.movable else shape  # the entity is where the task puts it


def thinned(points: np.ndarray, cloud: Cloud) -> np.ndarray:
    """One point of every voxel that has any ``[n, 3]``; none outside the cloud's region counts."""
    nx, ny, nz = cloud.size
    at = (points - np.array(cloud.low, dtype=np.float32)) / np.float32(cloud.voxel)
    inside = ((at >= 0.0) & (at < (nx, ny, nz))).all(axis=1)  # false for NaN, too
    x, y, z = at[inside].astype(np.int64).T
    _, first = np.unique((z * ny + y) * nx + x, return_index=True)
    return points[inside][first]


def box_of(shape: ShapeInfo, layout: Layout) -> tuple[np.ndarray, np.ndarray]:
    """Centre ``[3]`` and half extents ``[3]`` of a shape's bounding box in the shape's own frame [m]."""
    a, b, _ = shape.scale
    match shape.kind:
        case "mesh" if shape.mesh is not None:
            points = layout.meshes[shape.mesh][0] * np.array(shape.scale)
            low, high = points.min(axis=0), points.max(axis=0)
            return 0.5 * (low + high), 0.5 * (high - low)
        case "plane":
            return np.zeros(3), np.array([np.inf, np.inf, 0.0])
        case "sphere":
            half = (a, a, a)
        case "cylinder" | "cone":
            half = (a, a, b)
        case "capsule":
            half = (a, a, a + b)
        case _:
            half = shape.scale
    return np.zeros(3), np.array(half)


def scene_bounds(layout: Layout, body_q: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre ``[3]`` and radius [m] of everything finite in a scene and its goal."""
    low, high = goal[:3].astype(float), goal[:3].astype(float)
    for shape in layout.shapes:
        centre, half = box_of(shape, layout)
        if not np.isfinite(half).all():
            continue
        pose, radius = np.array(shape.pose), float(np.linalg.norm(half))
        at = pose[:3] + rotate(pose[3:], centre)
        if shape.body != WORLD:
            at = body_q[shape.body, :3] + rotate(body_q[shape.body, 3:], at)
        low, high = np.minimum(low, at - radius), np.maximum(high, at + radius)
    return 0.5 * (low + high), max(0.5, 0.5 * float(np.linalg.norm(high - low)))


class ContactPoints:
    """Points at which the net contact force between two things is drawn.

    Forces are known per pair, not per contact. The arrow starts at the point of the second thing's bounding boxes that
    is nearest to the centre of any of the first one's collision shapes: exact enough to see which side is touched.

    Args:
        first: Name of a robot or object.
        second: Name of an obstacle or of another robot.
    """

    def __init__(self, layout: Layout, first: str, second: str):
        shapes = [layout.shapes[i] for i in layout.entity(first).shapes]
        shapes = [s for s in shapes if s.collides and s.body != WORLD]
        self._body = np.array([s.body for s in shapes], dtype=int)
        self._centre = np.array([_in_parent(s, box_of(s, layout)[0]) for s in shapes]).reshape(-1, 3)
        self._boxes = []
        for shape in (layout.shapes[i] for i in layout.entity(second).shapes):
            if shape.collides:
                centre, half = box_of(shape, layout)
                self._boxes.append((shape.body, _in_parent(shape, centre), np.array(shape.pose[3:]), half))

    def __call__(self, body_q: np.ndarray) -> np.ndarray:
        """The point ``[3]`` for body poses ``[nb, 7]``."""
        centre = body_q[self._body, :3] + rotate(body_q[self._body, 3:], self._centre)
        found = [_nearest(centre, box, body_q) for box in self._boxes]
        return min(found, key=lambda entry: entry[0])[1] if found else np.zeros(3)


def arrows(
    force: np.ndarray, points: Sequence[ContactPoints], body_q: np.ndarray, *, smallest: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Arrows of the n pairs that touch: which pairs ``[n]``, origins ``[n, 3]`` and vectors ``[n, 3]`` [m].

    Args:
        force: Net force on the first of each pair ``[C, 3]`` [N].
        points: Where to draw each.
        smallest: Forces that are not larger are none [N].
    """
    size = np.linalg.norm(force, axis=1)
    touching = np.flatnonzero(size > smallest)
    origins = np.array([points[i](body_q) for i in touching]).reshape(-1, 3)
    length = np.minimum(FORCE_LENGTH * size[touching], FORCE_LENGTH_MAX)
    return touching, origins, force[touching] * (length / size[touching])[:, None]


def _nearest(points: np.ndarray, box: tuple, body_q: np.ndarray) -> tuple[float, np.ndarray]:
    """Distance from a box to the nearest of some points ``[n, 3]`` and its own point there, else its centre."""
    body, at, turn, half = box
    place = body_q[body] if body != WORLD else np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    if not len(points):
        return 0.0, place[:3] + rotate(place[3:], at)
    inside = rotate(place[3:] * (-1, -1, -1, 1), points - place[:3])
    local = rotate(turn * (-1, -1, -1, 1), inside - at)
    nearest = np.clip(local, -half, half)
    apart = np.linalg.norm(local - nearest, axis=1)
    closest = int(np.argmin(apart))
    return float(apart[closest]), place[:3] + rotate(place[3:], at + rotate(turn, nearest[closest]))


def _in_parent(shape: ShapeInfo, point: np.ndarray) -> np.ndarray:
    """A point of a shape's frame in the frame of its body."""
    pose = np.array(shape.pose)
    return pose[:3] + rotate(pose[3:], point)


def mesh_of(shape: ShapeInfo, layout: Layout, *, fine: bool = True) -> trimesh.Trimesh | None:
    """Mesh of a shape in its own frame [m], triangles counter-clockwise from outside; None without any.

    Args:
        shape: The shape; planes have none.
        fine: Whether round shapes have many triangles.
    """
    a, b, _ = shape.scale
    make, sides = trimesh.creation, 32 if fine else 24
    match shape.kind:
        case "mesh" if shape.mesh is not None:
            points, triangles = layout.meshes[shape.mesh]
            return trimesh.Trimesh(points * np.array(shape.scale), np.reshape(triangles, (-1, 3)), process=False)
        case "box":
            mesh = make.box(2.0 * np.array(shape.scale))
        case "sphere" | "ellipsoid":
            mesh = make.icosphere(3 if fine else 2, 1.0)
            mesh.apply_scale(a if shape.kind == "sphere" else shape.scale)
        case "cylinder":
            mesh = make.cylinder(a, 2.0 * b, sections=sides)
        case "capsule":
            mesh = make.capsule(2.0 * b, a, count=[24, 24] if fine else [12, 12])
        case "cone":
            mesh = make.cone(a, 2.0 * b, sections=sides)
        case _:
            return None
    mesh.apply_translation(-mesh.bounds.mean(axis=0))  # trimesh starts some at their foot
    return mesh
