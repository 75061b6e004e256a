# SPDX-License-Identifier: Apache-2.0
"""A run in real time for the rerun viewer, written when it is over."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from ...loop.realtime.agent import Fault
from ...scene.task.goal import GOAL
from .recorder import scene_view, series, side_by_side
from .scene_drawing import RecordingFile, body_path, draw_scene, entity_path, indexes_of, send_curves
from .shapes import scene_bounds

if TYPE_CHECKING:
    from ...loop.log.run_log import RunLog
    from ...loop.plant.plant import Plant


def record_ticks(path: str | Path, log: RunLog, plant: Plant) -> None:
    """Write a ``.rrd`` file of a run in real time.

    Entities: ``/scene/...`` bodies, ``/goal`` where it was at the end, ``/control`` what was sent at each tick,
    ``/plan`` the number of the newest plan, its age and wall time, ``/following`` 1 where the command came from it,
    ``/late_ms`` of each tick, ``/faults`` of the watchdog as log lines, ``/goal_error`` and ``/contact_force``. Where
    plans were logged ``/cost`` of every term and ``/temperature``, of all plans, at the times of what they were made
    from. Timelines: ``time`` (the plant's) and ``step``, the tick.

    Args:
        path: File to write, ``*.rrd``; an existing file is replaced.

    Raises:
        OSError: If the file cannot be written.
        ValueError: If its name does not end in ``.rrd``, or the log is not of a run in real time.
    """
    if not log.real_time:
        raise ValueError("this log is not one of a run in real time: it has no ticks")
    scene, layout, goal = plant.scene, plant.layout, plant.task.pose(GOAL)
    centre, radius = scene_bounds(layout, log.states.body_q[0], goal)
    file = RecordingFile(path, scene, _blueprint(plant, centre, radius, costs=len(log.plans) > 0))
    recording = file.stream
    try:
        draw_scene(recording, plant, reach=2.0 * radius)
        recording.log("/goal", rr.Transform3D(translation=goal[:3], quaternion=goal[3:]), static=True)
        for name in layout.movable:
            pose = plant.task.pose(name)
            at = rr.Transform3D(translation=pose[:3], quaternion=pose[3:])
            recording.log(entity_path("scene", name), at, static=True)
        _send(recording, log, plant)
    finally:
        file.close()


def _send(recording: rr.RecordingStream, log: RunLog, plant: Plant) -> None:
    states, controls, names = log.states, log.controls, log.names
    indexes = indexes_of(states.time, np.arange(len(states)))
    for body in range(plant.layout.nb):
        pose = states.body_q[:, body]
        columns = rr.Transform3D.columns(translation=pose[:, :3], quaternion=pose[:, 3:])
        recording.send_columns(body_path(plant.layout, body), indexes, columns)
    force = np.linalg.norm(states.contact_force[1:], axis=-1)
    curves = {
        **_curves("control", names["controls"], controls.control),
        "/plan/number": controls.plan,
        "/plan/age_ms": 1e3 * controls.age,
        "/plan_ms/plan": controls.plan_ms,
        "/plan_ms/budget": np.full(len(controls), 1e3 * plant.scene.timing.control_dt),
        "/following": controls.following,
        "/late_ms": controls.late_ms,
        **_curves("goal_error", names["errors"], states.goal_error[:-1]),
        **_curves("contact_force", names["pairs"], force),
    }
    send_curves(recording, curves, states.time[:-1], np.arange(len(controls)))
    if len(log.plans):  # all of them, those that no tick saw among them
        plans = log.plans
        costs = _curves("cost", names["terms"], plans.terms)
        costs |= {"/cost/total": plans.cost, "/temperature/beta": plans.beta, "/temperature/eta": plans.eta}
        steps = np.clip(np.searchsorted(states.time, plans.time), 0, len(states) - 1)
        send_curves(recording, costs, plans.time, steps)
    for fault in Fault.of(log):
        recording.set_time("time", duration=fault.start)
        recording.log("/faults", rr.TextLog(f"{fault.why}; sending the safe command", level="WARN"))
        if fault.end is not None:
            recording.set_time("time", duration=fault.end)
            recording.log("/faults", rr.TextLog(fault.recovery, level="INFO"))


def _curves(at: str, names: Sequence[str], values: np.ndarray) -> dict[str, np.ndarray]:
    """Columns by entity path."""
    return {entity_path(at, *name.split("/")): column for name, column in zip(names, values.T, strict=False)}


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
    return side_by_side(scene_view(centre, radius, ground=ground), right)
