# SPDX-License-Identifier: Apache-2.0
"""A run in real time for the rerun viewer, written when it is over."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from ..task.goal import GOAL
from .blueprint import scene_view, series
from .rerun_shapes import body_path, entity_path
from .scene_drawing import draw_scene, writable
from .shapes import scene_bounds

if TYPE_CHECKING:
    from ..plant.plant import Plant
    from .history import History


def record_ticks(path: str | Path, history: History, plant: Plant) -> None:
    """Write a ``.rrd`` file of a run in real time.

    Entities: ``/scene/...`` bodies, ``/goal`` where it was at the end, ``/control`` what was sent at each tick,
    ``/plan`` the number of the newest plan, its age and wall time, ``/following`` 1 where the command came from it,
    ``/late_ms`` of each tick, ``/faults`` of the watchdog as log lines, ``/goal_error`` and ``/contact_force``. Where
    plans were logged ``/cost`` of every term and ``/temperature``, of all plans, at the times of what they were made
    from. Timelines: ``time`` (the plant's) and ``step``, the tick.

    Args:
        path: File to write, ``*.rrd``; an existing file is replaced.
        history: The run (``TickRecorder.history``).
        plant: Its plant.

    Raises:
        OSError: If the file cannot be written.
        ValueError: If its name does not end in ``.rrd``, or the history is not of a run in real time.
    """
    if history.ticks is None:
        raise ValueError("this history is not one of a run in real time: it has no ticks")
    scene, layout, goal = plant.scene, plant.layout, plant.task.pose(GOAL)
    path = writable(path)
    centre, radius = scene_bounds(layout, history.body_q[0], goal)
    recording = rr.RecordingStream(f"warpmpc_{scene.name}")
    recording.set_log_tick_enabled(False)
    recording.set_log_time_enabled(False)
    try:
        recording.save(path, default_blueprint=_blueprint(plant, centre, radius, costs=history.made is not None))
        draw_scene(recording, plant, reach=2.0 * radius)
        recording.log("/goal", rr.Transform3D(translation=goal[:3], quaternion=goal[3:]), static=True)
        for name in layout.movable:
            pose = plant.task.pose(name)
            at = rr.Transform3D(translation=pose[:3], quaternion=pose[3:])
            recording.log(entity_path("scene", name), at, static=True)
        _send(recording, history, plant)
        recording.flush()
    except RuntimeError as error:
        raise OSError(f"cannot write the recording '{path}': {error}") from None
    finally:
        recording.disconnect()


def _send(recording: rr.RecordingStream, history: History, plant: Plant) -> None:
    """Everything that changes."""
    ticks = history.ticks
    indexes = _indexes(history.time)
    for body in range(plant.layout.nb):
        pose = history.body_q[:, body]
        columns = rr.Transform3D.columns(translation=pose[:, :3], quaternion=pose[:, 3:])
        recording.send_columns(body_path(plant.layout, body), indexes, columns)
    curves = {
        entity_path("control", *n.split("/")): c for n, c in zip(history.control_names, history.control.T, strict=True)
    }
    curves |= {"/plan/number": ticks.plan, "/plan/age_ms": 1e3 * ticks.age, "/plan_ms/plan": history.plan_ms}
    curves |= {"/plan_ms/budget": np.full(len(ticks.plan), 1e3 * plant.scene.timing.control_dt)}
    curves |= {"/following": ticks.following, "/late_ms": ticks.late_ms}
    curves |= {
        entity_path("goal_error", n): c[:-1] for n, c in zip(history.error_names, history.goal_error.T, strict=True)
    }
    force = np.linalg.norm(history.contact_force, axis=-1).T
    curves |= {entity_path("contact_force", n): c[1:] for n, c in zip(history.pair_names, force, strict=True)}
    for at, values in curves.items():
        keep = np.isfinite(values)
        if keep.any():
            scalars = rr.Scalars.columns(scalars=np.asarray(values, dtype=float)[keep])
            steps = np.flatnonzero(keep)
            recording.send_columns(at, _indexes(history.time[:-1][keep], steps), scalars)
    if history.made is not None:
        _send_costs(recording, history)
    for fault in ticks.faults:
        recording.set_time("time", duration=fault.start)
        recording.log("/faults", rr.TextLog(f"{fault.why}; sending the safe command", level="WARN"))
        if fault.end is not None:
            recording.set_time("time", duration=fault.end)
            recording.log("/faults", rr.TextLog(fault.recovery, level="INFO"))


def _send_costs(recording: rr.RecordingStream, history: History) -> None:
    """What all plans came to, those that no tick saw among them."""
    made = history.made
    curves = {entity_path("cost", name): cost for name, cost in zip(made.term_names, made.terms.T, strict=True)}
    curves |= {"/cost/total": made.cost, "/temperature/beta": made.beta, "/temperature/eta": made.eta}
    steps = np.clip(np.searchsorted(history.time, made.time), 0, len(history.time) - 1)
    for at, values in curves.items():
        keep = np.isfinite(values)
        if keep.any():
            indexes = _indexes(made.time[keep], steps[keep])
            recording.send_columns(at, indexes, rr.Scalars.columns(scalars=values[keep]))


def _indexes(time: np.ndarray, steps: np.ndarray | None = None) -> list[rr.TimeColumn]:
    steps = np.arange(len(time)) if steps is None else steps
    nanoseconds = np.round(1e9 * time).astype("timedelta64[ns]")
    return [rr.TimeColumn("time", duration=nanoseconds), rr.TimeColumn("step", sequence=steps)]


def _blueprint(plant: Plant, centre: np.ndarray, radius: float, *, costs: bool) -> rrb.Blueprint:
    """The scene on the left; what plans cost, what was sent, from which plan, and what went wrong on the right."""
    ground = None if plant.scene.ground is None else plant.scene.ground.height
    right = rrb.Vertical(
        *([series("cost of the best rollout", "cost")] if costs else []),
        series("control", "control"),
        series("1: follows the plan, 0: safe command", "following"),
        series("age of the plan [ms]", "plan/age_ms"),
        rrb.Tabs(series("plan [ms]", "plan_ms"), series("tick late [ms]", "late_ms"), active_tab=0),
        rrb.TextLogView(name="faults", origin="/faults"),
    )
    return rrb.Blueprint(
        rrb.Horizontal(scene_view(centre, radius, ground=ground), right, column_shares=[3, 2]),
        rrb.TimePanel(timeline="time", state="collapsed"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_views=False,
    )
