# SPDX-License-Identifier: Apache-2.0
"""Things that can be moved on the page: goal, targets and movable obstacles by handles, bodies by pulling at them."""

from __future__ import annotations

from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from ..task.goal import GOAL

if TYPE_CHECKING:
    import viser

    from .session import Session

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
