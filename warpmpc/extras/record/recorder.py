# SPDX-License-Identifier: Apache-2.0
"""Recordings of a closed loop for the rerun viewer: ``rerun FILE.rrd``.

This module alone needs rerun; import it where a recording is wanted.

Layout of a recording: the scene on the left, what the planner thinks on the right.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from ...loop.plant.simulated import CONTACT_FORCE
from ...loop.run.run_recorder import turning
from ...physics.runtime.files import Unwritable
from ...planner.controller.rollout_paths import (
    BEST_COLOR,
    FAN,
    LANE,
    LANE_LENGTH,
    acting_frames,
    choose_rollouts,
    paths_of,
    predicted_lanes,
)
from ...scene.task.goal import GOAL
from .scene_drawing import RecordingFile, body_path, draw_scene, entity_path, indexes_of, send_curves
from .shapes import FORCE_COLOR, ContactPoints, arrows, scene_bounds, thinned

if TYPE_CHECKING:
    from ...loop.plant.plant import Plant
    from ...planner.controller.controller import Controller


def blueprint(
    centre: np.ndarray, radius: float, *, ground: float | None, contacts: bool, clouds: bool
) -> rrb.Blueprint:
    """The views of a recording.

    Args:
        centre: Centre of the scene ``[3]`` [m].
        radius: Its radius [m].
        ground: Height of the floor [m].
        contacts: Whether there are contact forces to show.
        clouds: Whether there are point clouds to show.
    """
    more = ("rollouts", "contact", *(["cloud"] if clouds else []))
    scene = scene_view(centre, radius, ground=ground, more=more)
    last = [series("plan [ms]", "plan_ms"), series("diverged worlds", "diverged_worlds")]
    if contacts:
        last.insert(1, series("contact force [N]", "contact_force"))
    right = rrb.Vertical(
        series("cost of the best rollout", "cost"),
        series("goal error [m, rad]", "goal_error"),
        rrb.Tabs(
            series("control", "control"),
            rrb.Spatial2DView(name="predicted controls", origin="/prediction"),
            active_tab=0,
        ),
        rrb.Horizontal(series("effective samples η", "temperature/eta"), series("temperature β", "temperature/beta")),
        rrb.Tabs(*last, active_tab=0),
    )
    return side_by_side(scene, right)


def side_by_side(scene: rrb.Spatial3DView, right: rrb.Vertical) -> rrb.Blueprint:
    """The scene on the left and curves on the right."""
    return rrb.Blueprint(
        rrb.Horizontal(scene, right, column_shares=[3, 2]),
        rrb.TimePanel(timeline="time", state="collapsed"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_views=False,
    )


def scene_view(
    centre: np.ndarray, radius: float, *, ground: float | None, more: Sequence[str] = ()
) -> rrb.Spatial3DView:
    """The view of bodies and goal.

    Args:
        centre: Centre of the scene ``[3]`` [m].
        radius: Its radius [m].
        ground: Height of the floor [m].
        more: What else is shown, names of entities.
    """
    floor = rr.encodings.Plane3D((0.0, 0.0, 1.0), ground or 0.0)
    return rrb.Spatial3DView(
        name="scene",
        origin="/",
        contents=[f"+ /{name}/**" for name in ("scene", "goal", *more)],
        line_grid=rrb.LineGrid3D(visible=ground is not None, plane=floor),
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=centre + 1.7 * radius * np.array([-0.35, -0.9, 0.85]),
            look_target=centre,
            eye_up=(0.0, 0.0, 1.0),
        ),
    )


def series(name: str, origin: str) -> rrb.TimeSeriesView:
    """A plot of all scalars below an entity path."""
    return rrb.TimeSeriesView(name=name, origin=f"/{origin}")


logger = logging.getLogger("warpmpc")

ROWS = 20
"""Steps that are written to the file together: as much as a killed run can lose."""
CLOUD_COLOR = (120, 190, 220)
CLOUD_RADIUS = 0.2
"""Half the width of a cloud's points, in voxels."""
LINE_RADIUS = {"samples": -0.75, "best": -2.5}
"""Half the width of the rollouts' lines; rerun takes negative numbers as points on the screen."""


class RerunRecorder:
    """Writes what plant and planner do to a ``.rrd`` file.

    The state of the plant is stamped with the plant's time; what the planner thought and sent is stamped with the
    time at which it did, one control earlier, so that rollouts start where the plant is seen. Timelines: ``time``
    (simulated) and ``step``. Infinite and NaN values are left out of the curves.

    Entities: ``/scene/...`` bodies with their shapes, ``/goal``, ``/rollouts/{best,samples}`` the ways of the goal's
    target and of the robots' frames, ``/contact`` forces on the robots, ``/cloud/NAME`` the points of a cloud, when
    they are new and one of each voxel, ``/prediction`` the controls of the best rollout over the horizon, each between
    its limits in its own lane, and the curves ``/cost``, ``/temperature``, ``/control``, ``/plan_ms`` (``budget``
    is one control), ``/goal_error``, ``/contact_force`` (at the last physics step of a control) and
    ``/diverged_worlds``.

    Rows are kept in memory and written every :data:`ROWS` steps, so that a call costs little and a run that is
    killed leaves a file that opens. Such a file has no footer: read it with ``RrdReader(file).stream()``, or give it
    one with ``rerun rrd filter --continue-on-error FILE.rrd > WHOLE.rrd``, which also drops a torn last row. When a
    file cannot be written any more (a full disk), an error is logged and the recording ends, not the run.

    Args:
        path: File to write, ``*.rrd``; an existing file is replaced.
        controller: The controller.
        plant: The plant, at the start of its episode.
        fan: Number of sampled rollouts to draw, spread evenly over the costs' ranking.

    Raises:
        OSError: If the file cannot be written.
        ValueError: If the file's name does not end in ``.rrd``, or ``fan`` is negative.
    """

    def __init__(self, path: str | Path, controller: Controller, plant: Plant, *, fan: int = FAN):
        if fan < 0:
            raise ValueError(f"fan is a number of rollouts, not {fan}")
        self.path = Path(path)
        self._controller, self._plant, self._fan = controller, plant, fan
        self._layout, scene = plant.layout, plant.scene
        self._dt = scene.timing.control_dt
        self._poses: dict[str, np.ndarray] = {}
        self._clouds: dict[str, np.ndarray] = {}
        self._frames = acting_frames(controller.scene, controller.layout)
        self._points = [ContactPoints(self._layout, pair.first, pair.second) for pair in plant.pairs]
        self._turning = turning(scene)
        self._bodies = [body_path(self._layout, body) for body in range(self._layout.nb)]
        self._curves = self._name_curves()
        self._states: list[tuple] = []
        self._plans: list[tuple] = []

        centre, radius = scene_bounds(self._layout, plant.body_q, self._goal_pose)
        ground = None if scene.ground is None else scene.ground.height
        views = blueprint(centre, radius, ground=ground, contacts=bool(plant.pairs), clouds=bool(scene.cloud))
        self._file = RecordingFile(self.path, scene, views)
        self._recording, self._failed = self._file.stream, False
        self._recording.send_recording_name(scene.title or scene.name)
        self._draw_scene(2.0 * radius)
        self._draw_poses()
        self._draw_clouds()
        self._take_state()
        self._send()

    def __enter__(self) -> RerunRecorder:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def log(self, control: np.ndarray) -> None:
        """Record one control step; call it after ``plant.apply(control)``.

        Args:
            control: The control ``[nu]`` that was applied.

        Raises:
            ValueError: If the recording is closed, or the controller or the plant has not made a step.
        """
        if self._recording is None:
            raise ValueError(f"the recording {self.path} is closed")
        if self._controller.info is None or self._plant.steps < 1:
            raise ValueError("log comes after controller.step and plant.apply")
        if self._failed:
            return
        self._draw_poses()
        self._draw_clouds()
        self._take_plan(np.asarray(control, dtype=np.float64))
        self._take_state()
        if len(self._plans) >= ROWS:
            self._send()

    def close(self) -> None:
        """Write what is left and finish the file; closing twice does no harm."""
        if self._recording is None:
            return
        self._send()
        self._recording = None
        self._note(self._file.close)

    # ---- what stays

    def _draw_scene(self, reach: float) -> None:
        recording = self._recording
        draw_scene(recording, self._plant, reach=reach)
        for at, name in self._curves:
            recording.log(at, rr.SeriesLines(names=name, widths=2.5 if at == "/cost/total" else 1.25), static=True)
        for name, radius in LINE_RADIUS.items():
            recording.log(f"/rollouts/{name}", rr.LineStrips3D.from_fields(radii=radius), static=True)
        recording.log("/rollouts/best", rr.LineStrips3D.from_fields(colors=BEST_COLOR), static=True)
        names, rest = self._layout.control_name, np.array([[0.0, 0.0], [LANE_LENGTH, 0.0]])
        empty = [rest + [0.0, LANE * i] for i in range(len(names))]
        recording.log("/prediction/rest", rr.LineStrips2D(empty, labels=names, colors=(128, 128, 128)), static=True)
        for cloud in self._plant.scene.cloud:
            look = rr.Points3D.from_fields(colors=CLOUD_COLOR, radii=CLOUD_RADIUS * cloud.voxel)
            recording.log(entity_path("cloud", cloud.name), look, static=True)
        recording.log("/contact", rr.Arrows3D.from_fields(colors=FORCE_COLOR, radii=0.012), static=True)

    def _name_curves(self) -> list[tuple[str, str]]:
        """Entity path and legend of every curve: first those of a plan, then those of a state."""
        controller, layout = self._controller, self._layout
        plan = [(entity_path("cost", label), label) for label in (*controller.costs.labels, "total")]
        plan += [(f"/temperature/{name}", symbol) for name, symbol in (("beta", "β"), ("eta", "η"))]
        plan += [(entity_path("control", *name.split("/")), name) for name in layout.control_name]
        plan += [(entity_path("plan_ms", stage), stage) for stage in ("total", "budget", *controller.plan_step.stages)]
        plan += [("/diverged_worlds", "diverged worlds")]
        self._plan_curves = len(plan)
        errors = ("position", *self._turning) if self._plant.scene.goal is not None else ()
        state = [(f"/goal_error/{name}", name) for name in errors]
        names = [f"{pair.first}-{pair.second}" for pair in self._plant.pairs]
        return plan + state + [(entity_path("contact_force", name), name) for name in names]

    # ---- what changes

    @property
    def _goal_pose(self) -> np.ndarray:
        """The goal the controller plans for, ``[7]``."""
        return self._controller.task.pose(GOAL)

    def _draw_poses(self) -> None:
        """The goal and the obstacles that move with the task, where they are new."""
        poses = {"/goal": self._goal_pose}
        poses |= {entity_path("scene", name): self._controller.task.pose(name) for name in self._layout.movable}
        for at, pose in poses.items():
            if at in self._poses and np.array_equal(pose, self._poses[at]):
                continue
            self._poses[at] = pose.copy()
            columns = rr.Transform3D.columns(translation=pose[None, :3], quaternion=pose[None, 3:])
            self._recording.send_columns(at, self._planned(), columns)

    def _draw_clouds(self) -> None:
        """The clouds whose points are new."""
        for cloud in self._plant.scene.cloud:
            points, drawn = self._controller.task.points(cloud.name), self._clouds.get(cloud.name)
            if points is drawn or (drawn is None and not len(points)):  # arrays are replaced, not changed in place
                continue
            self._clouds[cloud.name] = points
            shown = thinned(points, cloud)
            columns = rr.Points3D.columns(positions=shown).partition([len(shown)])
            self._recording.send_columns(entity_path("cloud", cloud.name), self._planned(), columns)

    def _take_state(self) -> None:
        plant, body_q = self._plant, self._plant.body_q
        error = plant.error
        force = np.zeros((len(plant.pairs), 3))
        if plant.pairs and plant.steps:
            force[:] = plant.forces
        size = np.linalg.norm(force, axis=1)
        touching, origins, vectors = arrows(force, self._points, body_q, smallest=CONTACT_FORCE)
        labels = [f"{size[i]:.1f} N" for i in touching]
        errors = [] if error is None else [error.position, *(getattr(error, name) for name in self._turning)]
        values = [*errors, *size]
        self._states.append((plant.steps, body_q, values, origins, vectors, labels))

    def _take_plan(self, control: np.ndarray) -> None:
        info = self._controller.info
        worlds, colors = choose_rollouts(self._controller, self._fan)
        rollouts = self._controller.engine.record(worlds)
        poses = rollouts.body_q[:, :, self._frames[0]]
        lanes = predicted_lanes(self._controller, rollouts.control[:, 0]) if len(worlds) else None
        values = [*info.terms.values(), info.cost, info.beta, info.eta, *control]
        values += [info.plan_ms, 1e3 * self._dt, *info.stages_ms.values(), info.diverged_worlds]
        self._plans.append((self._plant.steps - 1, values, poses, colors, lanes))

    # ---- to the file

    def _planned(self) -> list[rr.TimeColumn]:
        """Time of the last plan: one control before the state now reached."""
        return self._indexes([max(self._plant.steps - 1, 0)])

    def _indexes(self, steps: Sequence[int]) -> list[rr.TimeColumn]:
        steps = np.asarray(steps, dtype=np.int64)
        return indexes_of(self._dt * steps, steps)

    def _send(self) -> None:
        """Write all rows kept so far and wait until they are in the file."""
        if self._states:
            self._send_states()
        if self._plans:
            self._send_plans()
        self._states, self._plans = [], []
        self._note(self._file.flush)

    def _note(self, write: Callable[[], None]) -> None:
        """Write; a file that cannot be written is logged once, and nothing more is written."""
        try:
            write()
        except Unwritable as error:
            if not self._failed:
                logger.error("%s; the recording ends at t = %.2f s", error, self._plant.time)
            self._failed = True

    def _send_states(self) -> None:
        send = self._recording.send_columns
        steps, body_q, values, origins, vectors, labels = zip(*self._states, strict=True)
        indexes, body_q = self._indexes(steps), np.stack(body_q)
        for body, at in enumerate(self._bodies):
            pose = body_q[:, body]
            send(at, indexes, rr.Transform3D.columns(translation=pose[:, :3], quaternion=pose[:, 3:]))
        self._send_curves(self._curves[self._plan_curves :], steps, values)
        if self._points:
            text = [label for row in labels for label in row]
            arrows = rr.Arrows3D.columns(origins=np.concatenate(origins), vectors=np.concatenate(vectors), labels=text)
            send("/contact", indexes, arrows.partition([len(row) for row in labels]))

    def _send_plans(self) -> None:
        send = self._recording.send_columns
        steps, values, poses, colors, lanes = zip(*self._plans, strict=True)
        indexes, frames = self._indexes(steps), len(self._frames[0])
        self._send_curves(self._curves[: self._plan_curves], steps, values)
        best = np.concatenate([np.arange(p.shape[1]) == 0 for p in poses])  # the first of each row
        pose = np.concatenate(poses, axis=1)  # [T+1, rollouts of all rows, F, 7]
        ways = paths_of(pose, self._frames[1])  # [rollouts, F, T+1, 3]
        lengths = np.array([p.shape[1] for p in poses])
        lines = rr.LineStrips3D.columns(strips=ways[best].reshape(-1, *ways.shape[2:]))
        send("/rollouts/best", indexes, lines.partition(frames * np.minimum(lengths, 1)))
        lines = rr.LineStrips3D.columns(
            strips=ways[~best].reshape(-1, *ways.shape[2:]), colors=np.repeat(np.concatenate(colors), frames)
        )
        send("/rollouts/samples", indexes, lines.partition(frames * np.maximum(lengths - 1, 0)))

        shown = [lane for lane in lanes if lane is not None]
        if shown:
            at = self._indexes([step for step, lane in zip(steps, lanes, strict=True) if lane is not None])
            lines = rr.LineStrips2D.columns(strips=np.concatenate(shown))
            send("/prediction", at, lines.partition([len(lane) for lane in shown]))

    def _send_curves(self, curves: list[tuple[str, str]], steps: Sequence[int], values: Sequence[list[float]]) -> None:
        table, steps = np.array(values, dtype=np.float64), np.asarray(steps, dtype=np.int64)
        by_path = {at: table[:, i] for i, (at, _) in enumerate(curves)}
        send_curves(self._recording, by_path, self._dt * steps, steps)
