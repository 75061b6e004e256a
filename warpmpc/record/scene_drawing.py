# SPDX-License-Identifier: Apache-2.0
"""Static parts of a recording for rerun: shapes of bodies and of the goal."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from ..model.heightfields import heightfields
from ..model.layout import WORLD
from .rerun_shapes import body_path, draw_shape, entity_path, terrain
from .shapes import GHOST, drawn_shapes, shown_shapes

if TYPE_CHECKING:
    from ..plant.plant import Plant
    from ..scene.schema import Scene


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


def open_recording(name: str | Path, scene: Scene, views: rrb.Blueprint) -> rr.RecordingStream:
    """Open a recording that is written to a file; an existing one is replaced.

    Raises:
        ValueError: If the file's name does not end in ``.rrd``.
        OSError: If it cannot be written.
    """
    file = Path(name)
    if file.suffix != ".rrd":
        raise ValueError(f"a recording is a .rrd file, not '{file}'")
    recording = rr.RecordingStream(f"warpmpc_{scene.name}")
    recording.set_log_tick_enabled(False)
    recording.set_log_time_enabled(False)
    try:
        file.open("ab").close()
        recording.save(file, default_blueprint=views)
    except OSError as error:
        raise type(error)(error.errno, f"cannot write the recording: {error.strerror}", str(file)) from None
    except RuntimeError as error:
        raise OSError(f"cannot write the recording '{file}': {error}") from None
    return recording


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
