# SPDX-License-Identifier: Apache-2.0
"""Static parts of a recording for rerun: shapes of bodies and of the goal.

The shapes of a scene as rerun draws them, and the paths of their entities.
"""

from __future__ import annotations

import fcntl
import os
import re
import select
import stat
import termios
import threading
import time
from array import array
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
import trimesh

from ...physics.runtime.files import Unwritable, take, writing
from ...scene.model.hulls import heightfields
from ...scene.model.layout import WORLD
from .shapes import DEFAULT_COLOR, GHOST, GROUND_COLOR, drawn_shapes, mesh_of, shown_shapes

if TYPE_CHECKING:
    from ...loop.plant.plant import Plant
    from ...scene.model.hulls import Surface
    from ...scene.model.layout import Layout, ShapeInfo
    from ...scene.schema import Scene


def entity_path(*parts: str) -> str:
    """Entity path of these parts; a slash inside a part does not start a child."""
    return "/" + "/".join(rr.escape_entity_path_part(part) for part in parts)


def body_path(layout: Layout, body: int) -> str:
    """Entity path of a body, ``/scene/robot/link`` or ``/scene/object``; no body is the child of another."""
    owner = next((e.name for e in layout.entities if body in e.bodies), "")
    name = layout.body_name[body]
    link = name.removeprefix(f"{owner}/") if owner else name
    return entity_path("scene", owner, link) if owner and name != owner else entity_path("scene", name)


def draw_shape(
    recording: rr.RecordingStream, at: str, shape: ShapeInfo, layout: Layout, *, reach: float, opacity: float = 1.0
) -> None:
    """Log a shape once, for all times, as a child of the entity it is fixed to.

    Args:
        at: Entity path of the shape.
        reach: Half the edge of the square that stands for a plane [m].
        opacity: 1 is solid.
    """
    pose = rr.Transform3D(translation=shape.pose[:3], quaternion=shape.pose[3:])
    recording.log(at, pose, _geometry(shape, layout, reach, opacity), static=True)


def _geometry(shape: ShapeInfo, layout: Layout, reach: float, opacity: float) -> rr.AsComponents:
    a, b, _ = shape.scale
    ground = shape.kind == "plane" and shape.entity == "ground"
    color = [*(GROUND_COLOR if ground else shape.color or DEFAULT_COLOR), opacity]
    look = {
        "colors": [color],
        "fill_mode": rr.components.FillMode.Solid if opacity == 1.0 else "TransparentFillMajorWireframe",
    }
    match shape.kind:
        case "box":
            return rr.Boxes3D(half_sizes=[shape.scale], **look)
        case "sphere":
            return rr.Ellipsoids3D(half_sizes=[(a, a, a)], **look)
        case "ellipsoid":
            return rr.Ellipsoids3D(half_sizes=[shape.scale], **look)
        case "cylinder":
            return rr.Cylinders3D(lengths=[2.0 * b], radii=[a], **look)
        case "capsule":  # rerun's capsules start at their origin
            return rr.Capsules3D(lengths=[2.0 * b], radii=[a], translations=[(0.0, 0.0, -b)], **look)
        case "plane":
            points, triangles = _square(reach)
        case _:
            mesh = mesh_of(shape, layout)
            points, triangles = _square(0.0) if mesh is None else (mesh.vertices.astype(np.float32), mesh.faces)
    return _mesh(points, triangles, color)


def terrain(surface: Surface) -> rr.Mesh3D:
    """A heightfield as rerun draws it, in the world."""
    return _mesh(surface.points, surface.triangles, [*GROUND_COLOR, 1.0])


def _mesh(points: np.ndarray, triangles: np.ndarray, color: list[float]) -> rr.Mesh3D:
    normals = trimesh.Trimesh(points, triangles, process=False).vertex_normals.astype(np.float32)
    return rr.Mesh3D(vertex_positions=points, triangle_indices=triangles, vertex_normals=normals, albedo_factor=color)


def _square(reach: float) -> tuple[np.ndarray, np.ndarray]:
    """A square at z = 0, a little below, so that a grid drawn there stays visible."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=np.float32) * reach
    return np.column_stack([corners, np.full(4, -1e-3 * reach)]).astype(np.float32), np.array([[0, 1, 2], [0, 2, 3]])


def draw_scene(recording: rr.RecordingStream, plant: Plant, *, reach: float) -> None:
    """Log the shapes of a plant's bodies and of its goal, once, for all times.

    Args:
        reach: Half the edge of the square that stands for a plane [m].
    """
    layout, goal = plant.layout, plant.scene.goal
    recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for entity in layout.entities:
        for shape in drawn_shapes(plant, entity):
            parent = entity_path("scene", entity.name) if shape.body == WORLD else body_path(layout, shape.body)
            draw_shape(recording, parent + entity_path(shape.name), shape, layout, reach=reach)
    for surface in heightfields(plant.model):
        recording.log(entity_path("scene", *surface.name.split("/")), terrain(surface), static=True)
    if goal is not None and goal.object is not None:
        for shape in shown_shapes(layout, layout.entity(goal.object)):
            draw_shape(recording, "/goal" + entity_path(shape.name), shape, layout, reach=reach, opacity=GHOST)
    elif goal is not None:
        length = 0.15 * np.eye(3)
        colors = [(230, 50, 50), (50, 200, 50), (70, 90, 255)]
        recording.log("/goal/axes", rr.Arrows3D(vectors=length, colors=colors, radii=0.006), static=True)


class RecordingFile:
    """A recording that is written to a file; an existing one is replaced.

    rerun writes into a pipe, from which a thread takes what goes to the file: where a file cannot be written, rerun
    waits for ever.

    Args:
        name: The file.
        scene: The scene.
        views: What the viewer shows.

    Raises:
        ValueError: If the file's name does not end in ``.rrd``.
        Unwritable: If it cannot be written, or another run is writing it.
    """

    def __init__(self, name: str | Path, scene: Scene, views: rrb.Blueprint):
        self._path, self._error = Path(name), None
        if self._path.suffix != ".rrd":
            raise ValueError(f"a recording is a .rrd file, not '{self._path}'")
        self.stream = rr.RecordingStream(re.sub(r"[^A-Za-z0-9_-]+", "-", f"warpmpc_{scene.name}"))  # what it takes
        self.stream.set_log_tick_enabled(False)
        self.stream.set_log_time_enabled(False)
        with writing(self._path):
            self._file = open(self._path, "ab", buffering=0)  # noqa: SIM115
            if stat.S_ISREG(os.fstat(self._file.fileno()).st_mode) and not take(self._file):
                self._file.close()
                raise Unwritable(f"cannot write '{self._path}': another run is writing it")
            if os.fstat(self._file.fileno()).st_size:  # a device has none
                self._file.truncate(0)
        source, sink = os.pipe()
        self._pipe, self._writing = os.fdopen(source, "rb", buffering=0), threading.Lock()
        self._thread = threading.Thread(target=self._take, daemon=True)
        self._thread.start()
        self.stream.save(f"/dev/fd/{sink}", default_blueprint=views)
        os.close(sink)
        self.flush()

    def flush(self) -> None:
        """Write what was sent so far.

        Raises:
            Unwritable: If it cannot be written.
        """
        self.stream.flush()
        self._drain()

    def close(self) -> None:
        """Write what is left, with the file's end.

        Raises:
            Unwritable: If it could not be written.
        """
        self.stream.disconnect()
        self._drain()

    def _drain(self) -> None:
        """Wait until what is in the pipe is in the file."""
        waiting = array("i", [1])
        while waiting[0]:
            with self._writing:
                if self._pipe.closed:
                    break
                fcntl.ioctl(self._pipe, termios.FIONREAD, waiting)
            time.sleep(1e-4 * (waiting[0] > 0))
        if self._error is not None:
            raise self._error

    def _take(self) -> None:
        """Write what comes; after an error it is thrown away."""
        data = b"\0"
        while data:
            select.select([self._pipe], [], [])
            with self._writing:  # what is read is written before others see that the pipe is empty
                data = left = self._pipe.read(1 << 20)
                try:
                    with writing(self._path):
                        while left and self._error is None:
                            left = left[self._file.write(left) :]
                except Unwritable as error:
                    self._error = error
                if not data:
                    self._pipe.close()
                    self._file.close()


def indexes_of(time: np.ndarray, steps: np.ndarray) -> list[rr.TimeColumn]:
    """The timelines ``time`` [s] and ``step`` of rows ``[N]``."""
    nanoseconds = np.round(1e9 * time).astype("timedelta64[ns]")
    return [rr.TimeColumn("time", duration=nanoseconds), rr.TimeColumn("step", sequence=steps)]


def send_curves(
    recording: rr.RecordingStream, curves: Mapping[str, np.ndarray], time: np.ndarray, steps: np.ndarray
) -> None:
    """Send what is finite of curves ``[N]`` by entity path."""
    whole, descriptor = indexes_of(time, steps), rr.Scalars.descriptor_scalars()
    for at, values in curves.items():
        keep = np.isfinite(values)
        if keep.any():
            indexes = whole if keep.all() else indexes_of(time[keep], steps[keep])
            batch = rr.components.ScalarBatch(np.asarray(values, dtype=float)[keep])
            recording.send_columns(at, indexes, [rr.ComponentColumn(descriptor, batch)])
