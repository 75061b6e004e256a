# SPDX-License-Identifier: Apache-2.0
"""Shapes as points: corners whose convex hull is the shape, and points spread over its surface.

Heightfields of a scene as triangles. They are no shapes of its layout: they come from an asset's MJCF file.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from ..errors import SceneError

if TYPE_CHECKING:
    from .layout import Layout, ShapeInfo

SPACING = 0.008
"""Between the points of a surface that spheres cover [m]."""
_ROUND = 32
"""Corners of what stands for a circle."""
_BALL = 160
"""Corners of what stands for a ball."""


@dataclass(frozen=True)
class Hull:
    """A convex shape in its body's frame."""

    corners: np.ndarray
    """``[n, 3]`` [m]."""
    triangles: np.ndarray
    """Indices of corners ``[m, 3]``."""
    planes: np.ndarray
    """Outward normal and offset of each triangle, ``n·x + d`` is negative inside ``[m, 4]``."""
    surface: np.ndarray
    """Corners, points on edges and on faces, no farther apart than about the spacing asked for ``[p, 3]``."""

    def depth(self, points: np.ndarray) -> np.ndarray:
        """Depth of points ``[p, 3]`` inside; outside it is negative, and no farther than their distance [m]."""
        return -(points @ self.planes[:, :3].T + self.planes[:, 3]).max(axis=1)


def shape_hull(layout: Layout, shape: ShapeInfo, spacing: float) -> Hull:
    """The convex hull of a shape in its body's frame; round shapes become polyhedra, their corners on the surface.

    Args:
        layout: Layout the shape belongs to.
        shape: Any shape but a plane.
        spacing: Of the points on its surface [m].

    Raises:
        SceneError: If it is a mesh without volume.
    """
    local = _corners(layout, shape)
    corners = Rotation.from_quat(shape.pose[3:]).apply(local) + np.array(shape.pose[:3])
    try:
        hull = ConvexHull(corners)
    except QhullError:
        raise SceneError(
            "this mesh is flat or empty: it has no convex hull", key=shape.entity, found=shape.name
        ) from None
    triangles = hull.simplices
    used, triangles = np.unique(triangles, return_inverse=True)
    corners, triangles = corners[used], triangles.reshape(-1, 3)
    return Hull(corners, triangles, hull.equations, np.concatenate([corners, _spread(corners, triangles, spacing)]))


def _corners(layout: Layout, shape: ShapeInfo) -> np.ndarray:
    """Points whose convex hull is a shape, in the shape's own frame ``[n, 3]``."""
    a, b, _ = shape.scale
    angle = np.linspace(0.0, 2.0 * np.pi, _ROUND, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    match shape.kind:
        case "mesh":
            return layout.meshes[shape.mesh][0].astype(np.float64) * np.array(shape.scale)
        case "box":
            return np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3) * np.array(shape.scale)
        case "sphere":
            return a * directions(_BALL)
        case "ellipsoid":
            return directions(_BALL) * np.array(shape.scale)
        case "capsule":
            ball = a * np.concatenate([directions(_BALL), ring])  # with its equator, where the caps begin
            return np.concatenate([ball + b * up, ball - b * up])
        case "cylinder":
            return np.concatenate([a * ring + b * up, a * ring - b * up])
        case "cone":
            return np.concatenate([[b * up], a * ring - b * up])
    raise ValueError(f"a {shape.kind} has no corners")


def directions(count: int) -> np.ndarray:
    """Unit vectors spread evenly, a Fibonacci spiral ``[count, 3]``."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    angle = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)


def _spread(corners: np.ndarray, triangles: np.ndarray, spacing: float) -> np.ndarray:
    """Points on the edges and faces of triangles, about a spacing apart ``[p, 3]``."""
    edges = np.unique(np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    ends = corners[edges]
    points = [_between(ends, np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1), spacing)]
    # faces: rows along the longest edge, one after the other up to the corner opposite
    p = corners[triangles]
    sides = np.linalg.norm(p[:, [1, 2, 0]] - p, axis=2)
    turn = (sides.argmax(axis=1)[:, None] + np.arange(3)) % 3
    p = np.take_along_axis(p, turn[..., None], axis=1)  # the longest edge runs from corner 0 to corner 1
    longest = sides.max(axis=1)
    area = 0.5 * np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
    rows = np.ceil(2.0 * area / np.maximum(longest, 1e-12) / spacing).astype(int)
    for count in np.unique(rows[rows > 1]):
        chosen, size = p[rows == count], longest[rows == count]
        for k in range(1, count):
            share = k / count
            ends = chosen[:, :2] + share * (chosen[:, 2:] - chosen[:, :2])
            points.append(_between(ends, (1.0 - share) * size, spacing))
    return np.concatenate(points)


def _between(ends: np.ndarray, length: np.ndarray, spacing: float) -> np.ndarray:
    """Points between the ends of segments ``[n, 2, 3]``, no farther apart than the spacing ``[p, 3]``."""
    count = np.ceil(length / spacing).astype(int)
    points = [np.zeros((0, 3))]
    for n in np.unique(count[count > 1]):
        share = (np.arange(1, n) / n)[:, None]
        chosen = ends[count == n]
        points.append((chosen[:, None, 0] + share * (chosen[:, None, 1] - chosen[:, None, 0])).reshape(-1, 3))
    return np.concatenate(points)


def thinned(points: np.ndarray, *, step: float = SPACING, count: int | None = None) -> np.ndarray:
    """One point of every cell of a grid; of a coarser one until they are few enough."""
    low = points.min(axis=0)
    while True:
        cells = np.floor((points - low) / step).astype(np.int64)
        _, first = np.unique(cells @ np.array([1, 1 << 20, 1 << 40]), return_index=True)
        points, step = points[np.sort(first)], 1.2 * step
        if count is None or len(points) <= count:
            return points


FINEST = 256
"""Heights in a row and in a column at most: as fine as is seen of a whole field, and 1.6 MB for a page."""


@dataclass(frozen=True)
class Surface:
    """The upper side of a heightfield, in the world."""

    name: str
    """Name of its geom."""
    points: np.ndarray
    """Corners ``[n, 3]`` [m], float32."""
    triangles: np.ndarray
    """Indices of corners ``[m, 3]``, counter-clockwise from above."""


def heightfields(model: mujoco.MjModel) -> list[Surface]:
    """The heightfields of a model that stand still, each of at most :data:`FINEST` heights each way.

    Args:
        model: MuJoCo model (``Plant.model``).
    """
    fixed = model.body_weldid[model.geom_bodyid] == 0
    geoms = np.flatnonzero((model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD) & fixed)
    if not len(geoms):
        return []
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return [_surface(model, data, int(geom)) for geom in geoms]


def _surface(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> Surface:
    """The surface of one geom: rows run along y, columns along x, heights are shares of the highest, as in MJCF."""
    field = model.geom_dataid[geom]
    rows, columns, first = (int(a[field]) for a in (model.hfield_nrow, model.hfield_ncol, model.hfield_adr))
    height = model.hfield_data[first : first + rows * columns].reshape(rows, columns)
    half_x, half_y, top, _ = model.hfield_size[field]
    i, j = _chosen(rows), _chosen(columns)
    x, y = np.meshgrid(half_x * (2.0 * j / (columns - 1) - 1.0), half_y * (2.0 * i / (rows - 1) - 1.0))
    local = np.stack([x, y, top * height[np.ix_(i, j)]], axis=-1).reshape(-1, 3)
    points = local @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
    corner = np.arange(len(i) * len(j)).reshape(len(i), len(j))
    a, b, c, d = (part.ravel() for part in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return Surface(model.geom(geom).name or f"heightfield_{geom}", points.astype(np.float32), triangles)


def _chosen(count: int) -> np.ndarray:
    """Choice of the lines that are shown: the first and the last, and evenly spread ones in between."""
    return np.unique(np.linspace(0, count - 1, min(count, FINEST)).round().astype(int))
