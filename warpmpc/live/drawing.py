# SPDX-License-Identifier: Apache-2.0
"""The scene in the browser: bodies, goal, rollouts, forces."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import trimesh

from ..model.layout import IDENTITY, WORLD
from ..record.recorder import BEST_COLOR, FORCE_COLOR, FORCE_LENGTH, FORCE_LENGTH_MAX
from ..record.shapes import (
    DEFAULT_COLOR,
    GHOST,
    GROUND_COLOR,
    ContactPoints,
    resized,
    scene_bounds,
    shown_shapes,
)
from ..task.goal import GOAL
from .fan import segments

if TYPE_CHECKING:
    import viser

    from ..model.layout import Layout, ShapeInfo
    from ..plant.simulated import Plant
    from .session import Session, Snapshot

SMALLEST_FORCE = 1e-3
"""Forces below are not drawn [N]."""


class Drawing:
    """Draws a session's scene once, then moves it.

    Args:
        server: The page's server.
        session: The session.
    """

    def __init__(self, server: viser.ViserServer, session: Session):
        self._scene, self._session = server.scene, session
        self._dragged = False
        self.draw()
        centre, radius = self._bounds

        @server.on_client_connect
        def _look(client: viser.ClientHandle) -> None:
            client.camera.up_direction = (0.0, 0.0, 1.0)
            client.camera.position = tuple(centre + radius * np.array([-0.7, -1.1, 1.0]))
            client.camera.look_at = tuple(centre)

    def draw(self) -> None:
        """Draw the present plant from nothing."""
        scene, plant = self._scene, self._session.plant
        scene.reset()
        self._plant, layout, snapshot = plant, plant.layout, self._session.snapshot
        self._bounds = centre, radius = scene_bounds(layout, snapshot.body_q, snapshot.poses[GOAL])
        self._radius = radius
        scene.set_up_direction("+z")
        height = 0.0 if plant.scene.ground is None else plant.scene.ground.height
        scene.add_grid(
            "/grid",
            8.0 * radius,
            8.0 * radius,
            position=(float(centre[0]), float(centre[1]), height),
            cell_size=0.25 if radius > 0.6 else 0.1,
            section_size=1.0,
            fade_distance=12.0 * radius,
        )
        self._bodies = [scene.add_frame(f"/body/{body}", show_axes=False) for body in range(layout.nb)]
        self._movable = {name: scene.add_frame(f"/movable/{name}", show_axes=False) for name in layout.movable}
        for entity in layout.entities:
            for i, shape in enumerate(shown_shapes(layout, entity)):
                if shape.kind == "plane":
                    continue  # the grid stands for it
                if entity.kind != "robot":
                    shape = resized(shape, plant.properties)
                parent = f"/movable/{entity.name}" if entity.movable else f"/body/{shape.body}"
                if shape.body == WORLD and not entity.movable:
                    parent = "/world"
                pose = IDENTITY if entity.movable else shape.pose
                self._add(f"{parent}/{entity.name}_{i}", shape, layout, pose)
        self._draw_goal(plant, layout)
        self._points = [ContactPoints(layout, pair.first, pair.second) for pair in plant.pairs]
        self._lines: dict[str, object] = {}
        self._ways = None

    def _add(self, name: str, shape: ShapeInfo, layout: Layout, pose: np.ndarray, opacity: float | None = None) -> None:
        mesh = _mesh(shape, layout)
        if mesh is None:
            return
        color = tuple(GROUND_COLOR if shape.entity == "ground" else shape.color or DEFAULT_COLOR)[:3]
        at, turn = _split(pose)
        self._scene.add_mesh_simple(
            name,
            *mesh,
            color=tuple(int(255 * c) for c in color),
            opacity=opacity,
            flat_shading=shape.kind == "box",
            side="double",
            position=at,
            wxyz=turn,
        )

    def _draw_goal(self, plant: Plant, layout: Layout) -> None:
        """The goal, to be dragged; what it is a goal of, as a ghost."""
        goal = plant.scene.goal
        self._goal = None
        if goal is None:
            return
        at, turn = _split(self._session.snapshot.poses[GOAL])
        self._goal = self._scene.add_transform_controls(
            "/goal", scale=max(0.12, 0.2 * self._radius), position=at, wxyz=turn, depth_test=False, opacity=0.8
        )
        if goal.object is not None:
            for i, shape in enumerate(shown_shapes(layout, layout.entity(goal.object))):
                self._add(f"/goal/{i}", shape, layout, shape.pose, opacity=GHOST)
        else:
            self._scene.add_icosphere("/goal/ball", 0.03 * self._radius, color=(50, 200, 80), opacity=0.8)

        @self._goal.on_update
        def _moved(_: object) -> None:
            self._session.set_value(GOAL, np.array([*self._goal.position, *np.roll(self._goal.wxyz, -1)]))

        self._goal.on_drag_start(lambda _: setattr(self, "_dragged", True))
        self._goal.on_drag_end(lambda _: setattr(self, "_dragged", False))

    def update(self, snapshot: Snapshot) -> None:
        """Show a snapshot."""
        if self._session.plant is not self._plant:
            self.draw()
        for frame, pose in zip(self._bodies, snapshot.body_q, strict=False):
            _place(frame, pose)
        for name, frame in self._movable.items():
            _place(frame, snapshot.poses[name])
        if self._goal is not None and not self._dragged:
            _place(self._goal, snapshot.poses[GOAL])
        self._draw_ways(snapshot)
        self._draw_forces(snapshot)

    def _draw_ways(self, snapshot: Snapshot) -> None:
        ways = snapshot.ways
        if ways is self._ways:
            return
        self._ways = ways
        if ways is None or not ways.best.size:
            self._hide("/rollouts/fan", "/rollouts/best")
            return
        pieces = segments(ways.fan)
        colors = np.repeat(ways.colors, len(pieces) // max(1, len(ways.colors)), axis=0)
        self._line("/rollouts/fan", pieces, np.repeat(colors[:, None], 2, axis=1), 1.5)
        best = segments(ways.best)
        self._line("/rollouts/best", best, np.full((len(best), 2, 3), BEST_COLOR, np.uint8), 4.0)

    def _line(self, name: str, points: np.ndarray, colors: np.ndarray, thickness: float) -> None:
        self._lines[name] = self._scene.add_line_segments(
            name, points, colors, thickness=thickness, thickness_units="screen"
        )

    def _draw_forces(self, snapshot: Snapshot) -> None:
        size = np.linalg.norm(snapshot.forces, axis=1)
        touching = np.flatnonzero(size > SMALLEST_FORCE)
        if not len(touching):
            self._hide("/contact")
            return
        start = np.array([self._points[i](snapshot.body_q) for i in touching])
        length = np.minimum(FORCE_LENGTH * size[touching], FORCE_LENGTH_MAX)
        end = start + snapshot.forces[touching] * (length / size[touching])[:, None]
        thin = 0.01 * self._radius
        self._lines["/contact"] = self._scene.add_arrows(
            "/contact",
            np.stack([start, end], axis=1).astype(np.float32),
            FORCE_COLOR,
            shaft_radius=thin,
            head_radius=2.0 * thin,
            head_length=4.0 * thin,
        )

    def _hide(self, *names: str) -> None:
        for name in names:
            handle = self._lines.pop(name, None)
            if handle is not None:
                handle.remove()


def _split(pose: np.ndarray) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Position and quaternion (w, x, y, z) of a pose ``[7]``."""
    values = [float(v) for v in pose]
    return tuple(values[:3]), (values[6], *values[3:6])


def _place(handle: object, pose: np.ndarray) -> None:
    if np.isfinite(pose).all():
        handle.position, handle.wxyz = _split(pose)


def _mesh(shape: ShapeInfo, layout: Layout) -> tuple[np.ndarray, np.ndarray] | None:
    """Points ``[n, 3]`` and triangles ``[m, 3]`` of a shape in its own frame."""
    a, b, _ = shape.scale
    make = trimesh.creation
    match shape.kind:
        case "mesh":
            if shape.mesh is None:
                return None
            points, triangles = layout.meshes[shape.mesh]
            return (points * np.array(shape.scale)).astype(np.float32), np.asarray(triangles).reshape(-1, 3)
        case "box":
            mesh = make.box(2.0 * np.array(shape.scale))
        case "sphere":
            mesh = make.icosphere(3, a)
        case "ellipsoid":
            mesh = make.icosphere(3, 1.0)
            mesh.apply_scale(shape.scale)
        case "cylinder":
            mesh = make.cylinder(a, 2.0 * b, sections=32)
        case "capsule":
            mesh = make.capsule(2.0 * b, a, count=[24, 24])
        case "cone":
            mesh = make.cone(a, 2.0 * b, sections=32)
        case _:
            return None
    points = np.array(mesh.vertices)
    points -= 0.5 * (points.min(axis=0) + points.max(axis=0))  # trimesh starts some at their foot
    return points.astype(np.float32), np.array(mesh.faces)
