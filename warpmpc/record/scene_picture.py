# SPDX-License-Identifier: Apache-2.0
"""A scene's bodies in matplotlib (extra ``plot``), seen from anywhere: no window, no graphics driver."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.collections import LineCollection, PolyCollection
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from ..model.layout import WORLD
from .meshes import mesh_of
from .shapes import drawn_shapes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ..model.layout import Entity, Layout, ShapeInfo
    from ..plant.plant import Plant

COLORS = {"robot": (1.0, 0.55, 0.15), "object": (0.2, 0.5, 0.8), "obstacle": (0.6, 0.6, 0.6)}
FINE = 200
"""Triangles above which a mesh that moves is drawn as its convex hull."""
LEVEL = 0.03
"""Rise [m] and tilt [rad] that a body may have in a picture from above."""
LIGHT = np.array([-0.4, -0.5, 0.8]) / np.linalg.norm([-0.4, -0.5, 0.8])
"""Direction that light comes from, in the world."""


@dataclass(frozen=True)
class View:
    """From where a scene is seen, without perspective."""

    right: tuple[float, float, float]
    """Axis to the right in the picture."""
    up: tuple[float, float, float]
    labels: tuple[str, str] | None
    """Names of the picture's axes where they are axes of the world."""

    @property
    def towards(self) -> np.ndarray:
        """From the scene to whoever sees it ``[3]``."""
        return np.cross(self.right, self.up)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Points of the world ``[..., 3]`` in the picture ``[..., 2]`` [m]."""
        return points @ np.array([self.right, self.up]).T


def oblique(azimuth: float, elevation: float) -> View:
    """A view from a direction [rad], counted from the x-axis and from the ground."""
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    back = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    return View(tuple(right), tuple(np.cross(back, right)), None)


VIEWS = {
    "top": View((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), ("x [m]", "y [m]")),
    "side": View((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), ("x [m]", "z [m]")),
    "front": View((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), ("y [m]", "z [m]")),
    "3d": oblique(np.radians(-60.0), np.radians(25.0)),
}


def natural_view(layout: Layout, body_q: np.ndarray) -> str:
    """From above where no robot's body rises or tilts, such as a base on the ground; else in space.

    Args:
        body_q: Poses of all bodies over time ``[N, nb, 7]``.
    """
    robots = [body for entity in layout.entities if entity.kind == "robot" for body in entity.bodies]
    turn = Rotation.from_quat(body_q[:, robots, 3:].reshape(-1, 4))
    axis = turn.apply((0.0, 0.0, 1.0)).reshape(len(body_q), -1)
    level = np.concatenate([body_q[:, robots, 2], axis], axis=1)
    return "3d" if np.ptp(level, axis=0).max(initial=0.0) > LEVEL else "top"


def triangles_of(shape: ShapeInfo, layout: Layout, *, hull: bool) -> np.ndarray:
    """Triangles of a shape in its body's frame ``[n, 3, 3]`` [m], corners counter-clockwise from outside.

    Args:
        shape: The shape; planes have none.
        hull: Whether a fine mesh may be its convex hull.
    """
    mesh = mesh_of(shape, layout, fine=False)
    if mesh is None:
        return np.zeros((0, 3, 3))
    if hull and shape.kind == "mesh" and len(mesh.faces) > FINE:
        mesh = mesh.convex_hull
    return moved(mesh.triangles, np.array(shape.pose))


def moved(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Points ``[..., 3]`` of a frame whose pose is known ``[7]``, in the frame around it."""
    return (points.reshape(-1, 3) @ Rotation.from_quat(pose[3:]).as_matrix().T + pose[:3]).reshape(points.shape)


class ScenePicture:
    """Draws a plant's scene into axes, as it is now or with bodies elsewhere.

    Args:
        view: From where it is seen.
    """

    def __init__(self, axes: Axes, plant: Plant, view: View):
        self.axes, self.plant, self.view = axes, plant, view
        self._pieces = [(entity, *piece) for entity in plant.layout.entities for piece in self._pieces_of(entity)]

    def solid(self, body_q: np.ndarray, kinds: tuple[str, ...]) -> None:
        """Draw entities of some kinds with light and shade, the near before the far.

        Args:
            kinds: ``robot``, ``object`` or ``obstacle``.
        """
        corners, colors = [], []
        for entity, body, local in self._pieces:
            if entity.kind in kinds:
                corners.append(self._placed(entity, body, local, body_q))
                colors.append(np.tile(COLORS[entity.kind], (len(local), 1)))
        if not corners:
            return
        corners, colors = np.concatenate(corners), np.concatenate(colors)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        near = np.argsort(corners.mean(axis=1) @ self.view.towards)
        near = near[normal[near] @ self.view.towards > 0.0]
        shade = 0.55 + 0.45 * np.clip(normal[near] @ LIGHT, 0.0, 1.0)
        faces = np.clip(colors[near] * shade[:, None], 0.0, 1.0)
        self.axes.add_collection(PolyCollection(self.view(corners[near]), facecolors=faces, edgecolors=faces, lw=0.3))

    def outlines(self, body_q: np.ndarray, kinds: tuple[str, ...], *, alpha: float) -> None:
        """Draw the outlines of all shapes of some kinds, see-through.

        Args:
            kinds: ``robot``, ``object`` or ``obstacle``.
            alpha: 1 is solid.
        """
        for entity, body, local in self._pieces:
            if entity.kind not in kinds:
                continue
            flat = self.view(self._placed(entity, body, local, body_q)).reshape(-1, 2)
            try:
                ring = flat[ConvexHull(flat).vertices]
            except QhullError:  # seen from its edge
                continue
            color = COLORS[entity.kind]
            self.axes.add_collection(
                PolyCollection([ring], facecolors=(*color, alpha), edgecolors=(*color, alpha), lw=0.8)
            )

    def path(self, points: np.ndarray, **style: object) -> None:
        """Draw the way of a point over time ``[N, 3]``."""
        self.axes.plot(*self.view(points).T, **style)

    def ground(self) -> None:
        """Draw squares of half a metre on the ground below everything, where there is one and it is seen at a slant."""
        planes = [shape.pose[2] for shape in self.plant.layout.shapes if shape.kind == "plane" and shape.body == WORLD]
        if self.view.labels is not None or not planes or not self._pieces:
            return
        placed = [self._placed(*piece, self.plant.body_q).reshape(-1, 3) for piece in self._pieces]
        corners, height = 2.0 * np.concatenate(placed), max(planes)
        low, high = 0.5 * np.floor(corners.min(axis=0)), 0.5 * np.ceil(corners.max(axis=0))
        lines = [[(x, low[1], height), (x, high[1], height)] for x in np.arange(low[0], high[0] + 0.25, 0.5)]
        lines += [[(low[0], y, height), (high[0], y, height)] for y in np.arange(low[1], high[1] + 0.25, 0.5)]
        self.axes.add_collection(LineCollection(self.view(np.array(lines)), colors="0.85", lw=0.7, zorder=0))

    def _pieces_of(self, entity: Entity) -> list[tuple[int, np.ndarray]]:
        """Body and triangles of what is drawn of an entity."""
        if entity.kind not in COLORS:
            return []
        pieces = []
        for shape in drawn_shapes(self.plant, entity):
            corners = triangles_of(shape, self.plant.layout, hull=entity.kind != "obstacle")
            if len(corners):
                pieces.append((shape.body, corners))
        return pieces

    def _placed(self, entity: Entity, body: int, corners: np.ndarray, body_q: np.ndarray) -> np.ndarray:
        """Triangles in the world."""
        if entity.movable:
            return moved(corners, self.plant.pose(entity.name))
        return corners if body == WORLD else moved(corners, body_q[body])
