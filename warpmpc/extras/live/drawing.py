# SPDX-License-Identifier: Apache-2.0
"""The scene in the browser: bodies, what can be moved, rollouts, forces; after the first picture what changes.

Things that can be moved on the page: goal, targets and movable obstacles by handles, bodies by pulling at them.
"""

from __future__ import annotations

from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from ...planner.controller.rollout_paths import BEST_COLOR
from ...scene.model.hulls import heightfields
from ...scene.model.layout import WORLD
from ...scene.task.goal import GOAL
from ..record.shapes import (
    DEFAULT_COLOR,
    FORCE_COLOR,
    GHOST,
    GROUND_COLOR,
    ContactPoints,
    arrows,
    drawn_shapes,
    mesh_of,
    scene_bounds,
    shown_shapes,
)
from .foresight import segments

if TYPE_CHECKING:
    import viser

    from ...scene.model.layout import Layout, ShapeInfo
    from .session import Session
    from .snapshot import Snapshot

KEEP = 0.5
"""Wall time for which a handle stays where the browser put it, until the session has it, too [s]."""
TURN = 0.25
"""Way of the mouse that turns a body by one radian, in radii of the scene."""


class Gizmo:
    """A handle on one pose of the task.

    Args:
        pose: Where it is ``[7]``.
        size: Length of the arrows [m].
    """

    def __init__(self, scene: viser.SceneApi, session: Session, name: str, pose: np.ndarray, size: float):
        self._name, self._session, self._moved, self._held = name, session, 0.0, False
        self.node = f"/pose/{name}"
        wanted = _wanted(session, name)
        planar = wanted is not None and len(wanted.position) == 2
        self._handle = scene.add_transform_controls(
            self.node,
            scale=size,
            active_axes=(True, True, not planar),
            disable_rotations=wanted is not None and wanted.yaw is None and wanted.rotation is None,
            depth_test=False,
            opacity=0.8,
        )
        place(self._handle, pose)

        @self._handle.on_update
        async def _moved(event: viser.TransformControlsEvent) -> None:
            self._held, self._moved = event.phase != "end", perf_counter()
            self._session.set_value(name, np.array([*self._handle.position, *np.roll(self._handle.wxyz, -1)]))

    def update(self, pose: np.ndarray) -> None:
        """Show a pose ``[7]``, unless it is being dragged."""
        if not self._held and perf_counter() - self._moved > KEEP:
            place(self._handle, pose)


def _wanted(session: Session, name: str) -> object | None:
    """Goal or target of the scene; None for a movable obstacle."""
    scene = session.plant.scene
    return scene.goal if name == GOAL else next((target for target in scene.target if target.name == name), None)


def pulls(session: Session, mesh: viser.MeshHandle, body: str, radius: float) -> None:
    """Let the mouse pull at a body by its mesh, and turn it with the shift key.

    Args:
        mesh: Part of what the body looks like.
        radius: Radius of the scene [m].
    """

    async def drag(event: viser.SceneNodeDragEvent) -> None:
        start, end = np.array(event.start_position), np.array(event.end_position)
        if event.phase == "start":
            session.grab(body, start)
        elif event.phase == "end":
            session.release()
        elif event.modifier is None:
            session.pull(end)
        else:
            camera = event.client.camera
            view = camera.look_at - camera.position
            way = np.cross(end - start, view / np.linalg.norm(view))
            session.turn(way / (TURN * radius))

    mesh.on_drag("left")(drag)
    mesh.on_drag("left", modifier="shift")(drag)


def split(pose: np.ndarray) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Position and quaternion (w, x, y, z) of a pose ``[7]``."""
    values = [float(v) for v in pose]
    return tuple(values[:3]), (values[6], *values[3:6])


def place(handle: viser.SceneNodeHandle, pose: np.ndarray) -> None:
    """Put something at a pose ``[7]``, if it is finite."""
    if np.isfinite(pose).all():
        handle.position, handle.wxyz = split(pose)


SMALLEST_FORCE = 1e-3
"""Forces below are not drawn [N]."""
STILL = 1e-5
"""Smallest motion that is sent [m, or parts of a quaternion]."""
VIEW = np.array([-0.8, -1.2, 1.1])
"""From where the scene is seen, in radii from its middle."""
PULL_COLOR = (30, 120, 255)
MARK_COLOR = (50, 200, 80)


class Drawing:
    """Draws a session's plant once, then moves it."""

    def __init__(self, server: viser.ViserServer, session: Session, snapshot: Snapshot):
        self._server, self._scene, self._session = server, server.scene, session
        self._source: str | None = None
        self.draw(snapshot)

    def draw(self, snapshot: Snapshot) -> None:
        """Draw the present plant from nothing."""
        scene, plant = self._scene, self._session.plant
        scene.reset()
        self._build, layout = snapshot.build, plant.layout
        centre, self._radius = scene_bounds(layout, snapshot.body_q, snapshot.poses[GOAL])
        if self._source != snapshot.source:
            self._look(centre)
        self._source = snapshot.source
        self._draw_grid(centre, 0.0 if plant.scene.ground is None else plant.scene.ground.height)
        self._bodies = [scene.add_frame(f"/body/{body}", show_axes=False) for body in range(layout.nb)]
        self._shown = np.full((layout.nb, 7), np.nan)
        size = max(0.15, 0.3 * self._radius)
        names = [name for name in snapshot.poses if name != GOAL or plant.scene.goal is not None]
        self._gizmos = {n: Gizmo(scene, self._session, n, snapshot.poses[n], size) for n in names}
        for entity in layout.entities:
            for i, shape in enumerate(drawn_shapes(plant, entity)):
                parent = "/world" if shape.body == WORLD else f"/body/{shape.body}"
                node = self._gizmos[entity.name].node if entity.movable else f"{parent}/{entity.name}"
                mesh = self._add(f"{node}/{i}", shape, layout)  # for planes stands the grid
                if mesh is not None and shape.body != WORLD:
                    pulls(self._session, mesh, layout.body_name[shape.body], self._radius)
        for surface in heightfields(plant.model):
            ground = tuple(int(255 * c) for c in GROUND_COLOR)
            at = f"/world/{surface.name}"
            scene.add_mesh_simple(at, surface.points, surface.triangles, color=ground, side="double")
        self._mark_poses(layout)
        self._points = [ContactPoints(layout, pair.first, pair.second) for pair in plant.pairs]
        self._lines: dict[str, viser.LineSegmentsHandle | viser.ArrowHandle] = {}
        self._paths = None

    def _look(self, centre: np.ndarray) -> None:
        """Look at the whole scene, in pages that are open and in those to come."""
        clients = self._server.get_clients().values()
        for camera in (self._server.initial_camera, *(client.camera for client in clients)):
            camera.position, camera.look_at = tuple(centre + self._radius * VIEW), tuple(centre)

    def _draw_grid(self, centre: np.ndarray, height: float) -> None:
        self._scene.set_up_direction("+z")
        wide = self._radius > 0.6
        self._scene.add_grid(
            "/grid",
            8.0 * self._radius,
            8.0 * self._radius,
            position=(float(centre[0]), float(centre[1]), height),
            cell_size=0.25 if wide else 0.1,
            section_size=1.0 if wide else 0.5,
            fade_distance=12.0 * self._radius,
        )

    def _add(
        self, name: str, shape: ShapeInfo, layout: Layout, opacity: float | None = None
    ) -> viser.MeshHandle | None:
        mesh = mesh_of(shape, layout)
        if mesh is None:
            return None
        color = tuple(GROUND_COLOR if shape.entity == "ground" else shape.color or DEFAULT_COLOR)[:3]
        at, turn = split(shape.pose)
        return self._scene.add_mesh_simple(
            name,
            mesh.vertices.astype(np.float32),
            np.asarray(mesh.faces),
            color=tuple(int(255 * c) for c in color),
            opacity=opacity,
            flat_shading=shape.kind == "box",
            side="double",
            position=at,
            wxyz=turn,
        )

    def _mark_poses(self, layout: Layout) -> None:
        """Draw the thing that the goal is of, as a ghost; a ball for other poses that have no shape."""
        goal = self._session.plant.scene.goal
        for name, gizmo in self._gizmos.items():
            if name == GOAL and goal.object is not None:
                for i, shape in enumerate(shown_shapes(layout, layout.entity(goal.object))):
                    self._add(f"{gizmo.node}/{i}", shape, layout, opacity=GHOST)
            elif name not in layout.movable:
                self._scene.add_icosphere(f"{gizmo.node}/ball", 0.03 * self._radius, color=MARK_COLOR, opacity=0.8)

    def update(self, snapshot: Snapshot) -> None:
        """Show a snapshot."""
        if snapshot.build != self._build:
            self.draw(snapshot)
        with np.errstate(invalid="ignore"):
            moved = ~(np.abs(snapshot.body_q - self._shown).max(axis=1, initial=0.0) <= STILL)
        for body in np.flatnonzero(moved):
            place(self._bodies[body], snapshot.body_q[body])
        self._shown[moved] = snapshot.body_q[moved]
        for name, gizmo in self._gizmos.items():
            gizmo.update(snapshot.poses[name])
        self._draw_paths(snapshot)
        self._draw_forces(snapshot)
        pull = np.zeros((0, 2, 3)) if snapshot.pull is None else snapshot.pull[None]
        self._line("/pull", pull, np.full(pull.shape, PULL_COLOR), 3.0)

    def _draw_paths(self, snapshot: Snapshot) -> None:
        paths = snapshot.paths
        if paths is self._paths:
            return
        self._paths = paths
        if paths is None:
            self._hide("/rollouts/fan", "/rollouts/best")
            return
        pieces, best = segments(paths.others), segments(paths.best)
        colors = np.repeat(paths.colors, len(pieces) // max(1, len(paths.colors)), axis=0)
        self._line("/rollouts/fan", pieces, np.repeat(colors[:, None], 2, axis=1), 1.5)
        self._line("/rollouts/best", best, np.full((len(best), 2, 3), BEST_COLOR), 4.0)

    def _line(self, name: str, points: np.ndarray, colors: np.ndarray, thickness: float) -> None:
        """Draw line segments ``[n, 2, 3]``; as many as before are moved."""
        if not len(points):
            self._hide(name)
            return
        points, colors, line = points.astype(np.float32), colors.astype(np.uint8), self._lines.get(name)
        if line is None or line.points.shape != points.shape:
            self._lines[name] = self._scene.add_line_segments(
                name, points, colors, thickness=thickness, thickness_units="screen"
            )
            return
        line.points, line.visible = points, True
        if not np.array_equal(line.colors, colors):
            line.colors = colors

    def _draw_forces(self, snapshot: Snapshot) -> None:
        touching, start, vectors = arrows(snapshot.forces, self._points, snapshot.body_q, smallest=SMALLEST_FORCE)
        at = "/contact"
        if not len(touching):
            self._hide(at)
            return
        points, thin = np.stack([start, start + vectors], axis=1).astype(np.float32), 0.01 * self._radius
        line = self._lines.get(at)
        if line is not None and line.points.shape == points.shape:
            line.points, line.visible = points, True
            return
        self._lines[at] = self._scene.add_arrows(
            at, points, FORCE_COLOR, shaft_radius=thin, head_radius=2.0 * thin, head_length=4.0 * thin
        )

    def _hide(self, *names: str) -> None:
        for name in names:
            if name in self._lines:
                self._lines[name].visible = False
