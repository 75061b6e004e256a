# SPDX-License-Identifier: Apache-2.0
"""Path lengths around obstacles in the ground plane, by fast marching (scikit-fmm)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from ..scene.layout import Layout, ShapeInfo


class Grid:
    """A grid over everything in the scene, and the obstacles' distance on it.

    Args:
        layout: The scene's layout.
        points: Further places the grid must cover, ``[n, 2]``, such as starts and goals.
        cell: Cell size [m].
        margin: Space left around everything [m].
    """

    def __init__(self, layout: Layout, points: np.ndarray, *, cell: float = 0.05, margin: float = 1.0):
        obstacles = [layout.shapes[i] for e in layout.group("obstacles") for i in e.shapes]
        obstacles = [shape for shape in obstacles if shape.kind != "plane"]
        corners = [_corners(layout, shape) for shape in obstacles]
        low, high = np.min([p.min(0) for p in (*corners, points)], 0), np.max([p.max(0) for p in (*corners, points)], 0)
        self.cell = cell
        self.origin = (low - margin).astype(np.float64)
        columns, rows = np.ceil((high - low + 2 * margin) / cell).astype(int) + 1
        x = self.origin[0] + cell * np.arange(columns)
        y = self.origin[1] + cell * np.arange(rows)
        self.points = np.stack(np.meshgrid(x, y), axis=-1)  # [rows, columns, 2]
        self.clearance = np.full((rows, columns), np.inf)
        for corner in corners:
            self.clearance = np.minimum(self.clearance, _polygon_distance(self.points, corner))

    def path_length(self, target: np.ndarray, inflation: float) -> np.ndarray:
        """Length [m] of the shortest path from every cell to a point, ``[rows, columns]``.

        Cells inside the grown obstacles hold the value of the nearest free cell plus twice the way there, so that
        the field leads out of them; a target inside is reached through its own surroundings.

        Args:
            target: Point (x, y) [m].
            inflation: Obstacles grow by this [m].
        """
        import skfmm
        from scipy.ndimage import distance_transform_edt

        from_target = np.linalg.norm(self.points - target, axis=-1)
        blocked = (self.clearance < inflation) & (from_target > 2.0 * self.cell)
        # around a target inside a grown obstacle the way out along the clearance's gradient is free
        if (reach := inflation - self._clearance_at(target)) > 0.0:
            blocked &= from_target > reach + 1.5 * self.cell
        start = np.ma.MaskedArray(from_target - 1.5 * self.cell, mask=blocked)
        length = skfmm.distance(start, dx=self.cell) + 1.5 * self.cell
        known = ~np.ma.getmaskarray(length)
        length = np.where(known, np.ma.getdata(length), 0.0)
        depth, nearest = distance_transform_edt(~known, sampling=self.cell, return_indices=True)
        return np.where(known, length, length[tuple(nearest)] + 2.0 * depth)

    def nearest(self, p: np.ndarray) -> np.ndarray:
        """The point itself (x, y) [m], or the nearest one on the grid; beyond it there is nothing to go around."""
        return np.clip(p, self.origin, self.points[-1, -1])

    def nearest_free(self, inflation: float) -> tuple[np.ndarray, np.ndarray]:
        """The nearest cell outside the grown obstacles, of every cell.

        Args:
            inflation: Obstacles grow by this [m].

        Returns:
            Its index row · columns + column, and the distance to it [m], both ``[rows, columns]``.
        """
        from scipy.ndimage import distance_transform_edt

        blocked = self.clearance < inflation
        if blocked.all():  # nowhere to go: as if nothing were in the way
            blocked[:] = False
        depth, (row, column) = distance_transform_edt(blocked, sampling=self.cell, return_indices=True)
        return (row * blocked.shape[1] + column).astype(np.int32), depth.astype(np.float32)

    def waypoints(self, inflation: float, *, spacing: float = 0.2) -> np.ndarray:
        """Points (x, y) on the borders of the grown obstacles, about ``spacing`` [m] apart, ``[M, 2]``.

        Args:
            inflation: Obstacles grow by this [m].
            spacing: Distance between neighbours [m].
        """
        from scipy.ndimage import binary_dilation

        blocked = self.clearance < inflation
        border = self.points[binary_dilation(blocked, structure=np.ones((3, 3))) & ~blocked]
        kept: list[np.ndarray] = []
        for point in border:
            if all(np.linalg.norm(point - other) >= spacing for other in kept):
                kept.append(point)
        return np.array(kept).reshape(-1, 2)

    def _clearance_at(self, p: np.ndarray) -> float:
        column, row = np.clip(np.round((p - self.origin) / self.cell).astype(int), 0, None)
        rows, columns = self.clearance.shape
        return float(self.clearance[min(row, rows - 1), min(column, columns - 1)])


def _corners(layout: Layout, shape: ShapeInfo) -> np.ndarray:
    """Convex outline of a static shape seen from above, counter-clockwise, [n, 2]."""
    from scipy.spatial import ConvexHull
    from scipy.spatial.transform import Rotation

    if shape.kind == "mesh":
        points = layout.meshes[shape.mesh][0] * np.array(shape.scale)
    elif shape.kind == "box":
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
        points = signs * np.array(shape.scale)
    else:
        angle = np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)
        radius, half = shape.scale[0], (0.0 if shape.kind == "sphere" else shape.scale[1])
        ring = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1) * radius
        points = np.concatenate([ring + [0, 0, half], ring - [0, 0, half]])
        if shape.kind in ("sphere", "capsule"):
            caps = np.roll(ring, 1, axis=1)
            points = np.concatenate([points, caps + [0, 0, half], caps - [0, 0, half]])
    world = Rotation.from_quat(shape.pose[3:]).apply(points)[:, :2] + np.array(shape.pose[:2])
    return world[ConvexHull(world).vertices]


def _polygon_distance(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Signed distance of points [..., 2] to a convex counter-clockwise polygon [n, 2], negative inside."""
    outside = np.full(points.shape[:-1], np.inf)
    inside = np.ones(points.shape[:-1], dtype=bool)
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        edge = b - a
        along = np.clip(((points - a) @ edge) / (edge @ edge), 0.0, 1.0)
        outside = np.minimum(outside, np.linalg.norm(points - a - along[..., None] * edge, axis=-1))
        inside &= edge[0] * (points[..., 1] - a[1]) - edge[1] * (points[..., 0] - a[0]) >= 0.0
    return np.where(inside, -outside, outside)
