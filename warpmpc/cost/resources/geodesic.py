# SPDX-License-Identifier: Apache-2.0
"""A grid over the ground plane: how far the obstacles are, and what shortest paths around them are made of.

The grid over the ground plane that distance fields and push values of a scene share.
"""

from __future__ import annotations

from copy import copy
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ...kernels.geometry.fields import sight_kernel
from .resource import Resource

if TYPE_CHECKING:
    from collections.abc import Collection

    from ...scene.model.layout import Layout, ShapeInfo
    from .resource import Resources


class Grid:
    """A grid over everything in the scene, and the obstacles' distance on it.

    Args:
        layout: The scene's layout.
        points: Further places the grid must cover, ``[n, 2]``, such as starts and goals.
        supports: Obstacles that things lie on, which are not in the way.
        cell: Cell size [m].
        margin: Space left around everything [m].
    """

    def __init__(
        self,
        layout: Layout,
        points: np.ndarray,
        *,
        supports: Collection[str] = (),
        cell: float = 0.05,
        margin: float = 1.0,
    ):
        self.outlines = [corners for _, corners in obstacle_outlines(layout, supports)]
        covered = np.concatenate([points, *self.outlines])
        low, high = covered.min(axis=0), covered.max(axis=0)
        self.cell = cell
        self.origin = (low - margin).astype(np.float64)
        columns, rows = np.ceil((high - low + 2 * margin) / cell).astype(int) + 1
        x = self.origin[0] + cell * np.arange(columns)
        y = self.origin[1] + cell * np.arange(rows)
        self.points = np.stack(np.meshgrid(x, y), axis=-1)  # [rows, columns, 2]
        self.clearance = self._clearance(self.points)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Grid) and self._content == other._content

    def __hash__(self) -> int:
        return hash(self._content)

    @property
    def _content(self) -> tuple[object, ...]:
        return (self.cell, *(a.tobytes() for a in (self.points, *self.outlines)))

    def turned(self, point: np.ndarray, yaw: float) -> tuple[Grid, tuple[int, int]]:
        """A square grid over the same area in its own frame, and the column and row of the frame's origin.

        Args:
            point: Origin (x, y) of the frame [m]; it is on a cell of the new grid, which moves to hold it if it must.
            yaw: Heading of the frame [rad].

        Returns:
            A grid whose ``origin`` is in that frame and whose ``points`` are in the world.
        """
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        size = self.size(self.clearance.shape)
        middle = (0.5 * (self.points[0, 0] + self.points[-1, -1]) - np.asarray(point)) @ turn
        cell = np.clip(np.round(0.5 * (size - 1) - middle / self.cell), 0, size - 1).astype(int)
        grid = copy(self)
        grid.origin = -self.cell * cell.astype(np.float64)
        x, y = (self.cell * (np.arange(size) - c) for c in cell)
        grid.points = np.stack(np.meshgrid(x, y), axis=-1) @ turn.T + np.asarray(point)
        grid.clearance = self._clearance(grid.points)
        return grid, (int(cell[0]), int(cell[1]))

    @staticmethod
    def size(shape: tuple[int, int]) -> int:
        """Rows and columns of a turned grid: enough for the other's diagonal."""
        return int(np.ceil(np.hypot(*shape)))

    def _clearance(self, points: np.ndarray) -> np.ndarray:
        """Distance of points ``[..., 2]`` from the nearest obstacle [m], negative inside, infinite without any."""
        clearance = np.full(points.shape[:-1], np.inf)
        for corners in self.outlines:
            clearance = np.minimum(clearance, polygon_distance(points, corners))
        return clearance

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

    def border(self, inflation: float) -> np.ndarray:
        """The free cells (x, y) next to the grown obstacles, ``[n, 2]`` [m].

        Args:
            inflation: Obstacles grow by this [m].
        """
        from scipy.ndimage import binary_dilation

        blocked = self.clearance < inflation
        return self.points[binary_dilation(blocked, structure=np.ones((3, 3))) & ~blocked]

    def sight(self, inflation: float, points: np.ndarray, waypoints: np.ndarray) -> np.ndarray:
        """Length [m] of the straight way from every point to every waypoint, ``[N, M]``, infinite where blocked.

        Args:
            inflation: Obstacles grow by this [m].
            points: Points (x, y) ``[N, 2]`` [m].
            waypoints: Points (x, y) ``[M, 2]`` [m].
        """
        sight = wp.zeros((len(points), len(waypoints)), dtype=float, device="cpu")
        if sight.size:
            clearance = wp.array(np.minimum(self.clearance, 1e6)[None], dtype=float, device="cpu")
            ends = [wp.array(p, dtype=wp.vec2, device="cpu") for p in (points, waypoints)]
            wp.launch(
                sight_kernel,
                dim=sight.shape,
                inputs=[clearance, inflation, wp.vec2(*self.origin), self.cell, *ends],
                outputs=[sight],
                device="cpu",
            )
        return sight.numpy()

    def ways(self, inflation: float, *, spacing: float = 0.2) -> tuple[np.ndarray, np.ndarray]:
        """Pieces of shortest paths that are not straight: waypoints on the borders of the grown obstacles.

        Args:
            inflation: Obstacles grow by this [m].
            spacing: Least distance between waypoints [m].

        Returns:
            Straight ways from every cell to every waypoint, ``[rows · columns, M]``, infinite where blocked; path
            lengths between waypoints, ``[M, M]``, by Dijkstra's algorithm over all cells of the borders (SciPy). [m]
        """
        from scipy.sparse.csgraph import shortest_path

        border = self.border(inflation)
        kept: list[int] = []
        for i, point in enumerate(border):
            if all(np.linalg.norm(point - border[k]) >= spacing for k in kept):
                kept.append(i)
        if not kept:
            return np.zeros((self.clearance.size, 0)), np.zeros((0, 0))
        edges = self.sight(inflation, border, border)
        between = shortest_path(np.minimum(edges, edges.T), directed=False, indices=kept)[:, kept]
        return self.sight(inflation, self.points.reshape(-1, 2), border[kept]), between


def obstacle_outlines(layout: Layout, supports: Collection[str]) -> list[tuple[str, np.ndarray]]:
    """Obstacles in the way of what moves in the plane, by name, and their convex outlines ``[n, 2]`` [m].

    Args:
        layout: Layout of the scene.
        supports: Obstacles that things lie on, which are not in the way.
    """
    shapes = [(e.name, layout.shapes[i]) for e in layout.group("obstacles") if e.name not in supports for i in e.shapes]
    return [(name, outline(layout, shape)) for name, shape in shapes if shape.kind != "plane"]


def outline(layout: Layout, shape: ShapeInfo, to_frame: wp.transform | None = None) -> np.ndarray:
    """Convex outline of a shape seen from above, counter-clockwise, ``[n, 2]`` [m].

    Args:
        layout: Layout the shape belongs to.
        shape: Any shape but a plane.
        to_frame: From the shape's body to the frame it is wanted in; the body's own when left out.
    """
    from scipy.spatial.transform import Rotation

    if shape.kind == "mesh":
        points = layout.meshes[shape.mesh][0] * np.array(shape.scale)
    elif shape.kind == "box":
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
        points = signs * np.array(shape.scale)
    else:
        radius, half = shape.scale[0], (0.0 if shape.kind == "sphere" else shape.scale[1])
        points = np.array([[0.0, 0.0, half], [0.0, 0.0, -half]])
        angle = np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)
        ring = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1) * radius
        if shape.kind not in ("sphere", "capsule"):
            points = (points[:, None] + ring).reshape(-1, 3)
    pose = wp.transform(*shape.pose) if to_frame is None else to_frame * wp.transform(*shape.pose)
    corners = Rotation.from_quat([*pose.q]).apply(points)[:, :2] + np.array([*pose.p])[:2]
    if shape.kind in ("sphere", "capsule"):  # round ends look the same from everywhere
        corners = (corners[:, None] + ring[:, :2]).reshape(-1, 2)
    return convex_outline(corners)


def convex_outline(points: np.ndarray) -> np.ndarray:
    """Corners of the convex hull of points ``[n, 2]``, counter-clockwise."""
    from scipy.spatial import ConvexHull

    return points[ConvexHull(points).vertices]


def polygon_distance(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Signed distance of points [..., 2] to a convex counter-clockwise polygon [n, 2], negative inside."""
    outside = np.full(points.shape[:-1], np.inf)
    inside = np.ones(points.shape[:-1], dtype=bool)
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        edge = b - a
        along = np.clip(((points - a) @ edge) / (edge @ edge), 0.0, 1.0)
        outside = np.minimum(outside, np.linalg.norm(points - a - along[..., None] * edge, axis=-1))
        inside &= edge[0] * (points[..., 1] - a[1]) - edge[1] * (points[..., 0] - a[0]) >= 0.0
    return np.where(inside, -outside, outside)


CELL = 0.05
"""Cell of the grid [m], if no term asks for a finer one, ..."""
LEAST_CELL = 0.01
"""... down to this: memory and time of searches grow with its square."""
MARGIN = 1.0
"""Space around everything in the scene [m], if no term asks for more cells."""


class Ground(Resource):
    """A grid that covers starts, goal and obstacles, as fine and as wide as the terms ask for."""

    def __init__(self, resources: Resources):
        self._scene, self._layout = resources.scene, resources.layout
        self._cells = [CELL]
        self._margins: list[int] = []
        self._room = [0.0]

    def need(self, *, room: float, cell: float = CELL, margin: int = 0) -> None:
        """Say what a term needs, before the grid is made.

        Args:
            room: How far around everything things move or obstacles grow [m].
            cell: Largest cell [m].
            margin: Cells around everything in the scene.
        """
        self._cells.append(cell)
        self._room.append(room)
        if margin:
            self._margins.append(margin)

    def allocate(self, envs: int, device: str) -> None:
        """Nothing lives on the device."""

    @cached_property
    def grid(self) -> Grid:
        """The grid; made when it is first used."""
        scene, layout = self._scene, self._layout
        starts = [item.position[:2] for item in (*scene.object, *scene.robot) if item.position]
        for robot in scene.robot:
            moving = [j for j in layout.entity(robot.name).joints if layout.joint_dof_dim[j].any()]
            axes = "".join("xr"[i] * n for j in moving for i, n in enumerate(layout.joint_dof_dim[j]))
            if axes.startswith("xx"):  # a base that moves in the plane
                q = layout.joint_q_start[moving[0]]
                starts.append(np.add((robot.position or (0.0, 0.0))[:2], layout.joint_q[q : q + 2]))
        goals = [pose.position[:2] for pose in (scene.goal, *scene.target) if pose is not None]
        goals += [phase.goal.position[:2] for phase in scene.phase if phase.goal is not None]
        points = np.array([*goals, *starts], dtype=float)
        supports = {obstacle.name for obstacle in scene.obstacle if obstacle.support}
        if not self._margins:
            return Grid(layout, points, supports=supports, cell=CELL, margin=MARGIN)
        cell = max(min(self._cells), LEAST_CELL)
        margin = max(max(self._margins) * cell, max(self._room) + 5 * cell)
        return Grid(layout, points, supports=supports, cell=cell, margin=margin)
