# SPDX-License-Identifier: Apache-2.0
"""Figures of a run, from its log; needs matplotlib (extra ``plot``)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from ..model.compiled import compile_scene
from ..plant.foresight import Foresight, foresee, logged_steps, takes_mujoco_steps
from ..plant.plant import Plant
from ..scene.errors import SceneError
from ..task.goal import GOAL
from .replay import logged_scene
from .scene_picture import COLORS, VIEWS, ScenePicture, natural_view

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ..cost.term import UserTerm
    from ..log.run_log import RunLog
    from ..scene.schema import Scene

SNAPSHOTS = 9
"""Moments drawn."""
DPI = 110
PICTURES = (".png", ".pdf", ".svg")
"""Endings of pictures that are written."""


def plot_log(
    log: RunLog, folder: str | Path, *, title: str = "", scene: Scene | None = None, terms: Sequence[UserTerm] = ()
) -> list[Path]:
    """Write figures (PNG) of a run, and all its numbers (CSV).

    Args:
        log: The run.
        folder: Folder for the files; made if it is not there.
        title: Title of the figures.
        scene: The run's scene; that of the log if None. Without either nothing is drawn of bodies but their
            ways.
        terms: Users' own cost terms that the scene's success or phases name.

    Returns:
        The files.

    Raises:
        SceneError: If the scene of the log cannot be built here.
        OSError: If a file cannot be written.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    if scene is None and log.origin is not None:
        scene = logged_scene(log)
    log.save(folder / "history.csv")
    written = [folder / "history.csv"]
    for name, figure in figures(log, scene, terms):
        figure.axes[0].set_title(title)
        figure.savefig(folder / f"{name}.png", bbox_inches="tight")
        written.append(folder / f"{name}.png")
    return written


def plot_overview(
    log: RunLog, path: Path, *, title: str = "", scene: Scene | None = None, terms: Sequence[UserTerm] = ()
) -> None:
    """Write one picture of a run: its path, and costs, controls and errors over time.

    Args:
        log: The run.
        path: File, one of :data:`PICTURES`.
        title: Title of the picture.
        scene: The run's scene, as for :func:`plot_log`.
        terms: Users' own cost terms that the scene's success or phases name.

    Raises:
        SceneError: If the scene of the log cannot be built here.
        OSError: If the file cannot be written.
    """
    time, names = log.states.time, log.names
    curves = [("controls", log.controls.control, names["controls"])] * bool(len(log.controls))
    curves += [("goal error [m or rad]", log.states.goal_error, names["errors"])] * bool(names["errors"])
    costs = bool(names["terms"] and len(log.controls))
    figure = Figure(figsize=(15, 7), dpi=DPI, layout="constrained")
    grid = figure.add_gridspec(max(len(curves) + costs, 1), 2)
    draw_run(figure.add_subplot(grid[:, 0]), log, _plant(log, scene, terms))
    figure.axes[0].set_title(title)
    for row, (label, values, parts) in enumerate(curves, start=int(costs)):
        axes = figure.add_subplot(grid[row, 1])
        for name, column in zip(parts, values.T, strict=True):
            axes.plot(time[: len(column)], column, lw=1.0, label=name)
        axes.set_ylabel(label)
    if costs:
        draw_costs(figure.add_subplot(grid[0, 1]), log)
    for axes in figure.axes[1:]:
        axes.set_xlim(time[0], time[-1])
        axes.set_xlabel("time [s]")
        _legend(axes)
    figure.savefig(path)


def figures(log: RunLog, scene: Scene | None, terms: Sequence[UserTerm] = ()) -> Iterator[tuple[str, Figure]]:
    """Name and figure of everything that a log has: path, costs, controls, plan times, errors, forces, ticks."""
    controls, names = log.controls, log.names
    figure = Figure(figsize=(7, 7), dpi=DPI)
    draw_run(figure.add_subplot(), log, _plant(log, scene, terms))
    yield "path", figure
    if names["terms"] and len(controls):
        yield "costs", _curves(log, draw_costs)
    if len(controls):
        yield "controls", _rows(log, names["controls"], controls.control)
        yield "plan_times", _curves(log, draw_plan_times, scene)
    if names["errors"]:
        yield "errors", _errors(log, scene)
    if names["pairs"]:
        yield "contact_forces", _curves(log, draw_forces)
    if scene is not None and (foreseen := _foresight(log, scene, terms)) is not None:
        yield "foresight", _curves(log, draw_foresight, foreseen)
    if log.real_time:
        labels = ("follows the plan", "its age [ms]", "tick late [ms]")
        yield "ticks", _rows(log, labels, np.stack([controls.following, 1e3 * controls.age, controls.late_ms], axis=1))


def _plant(log: RunLog, scene: Scene | None, terms: Sequence[UserTerm]) -> Plant | None:
    """The run's plant, its task as it was at the last plan; None without its scene."""
    if scene is None:
        return None
    plant = Plant(scene, seed=log.origin["seed"] if log.origin else 0, terms=terms)
    if len(log.plans) and "task" in log.plans.dtype.names:
        plant.task.follow(log.plans.task[-1])
    return plant


def draw_run(
    axes: Axes, log: RunLog, plant: Plant | None, *, view: str | None = None, snapshots: int = SNAPSHOTS
) -> None:
    """Draw where everything went.

    Moments before the last are outlines, the later the darker; lines are the ways of last links and of objects, the
    star is the goal. Fine meshes that move are drawn as their convex hulls.

    Args:
        plant: A plant of its scene; without one ways alone are drawn, from above.
        view: One of :data:`~warpmpc.record.scene_picture.VIEWS`; from above where nothing rises or tilts if None.
    """
    if plant is None:
        for name, way in zip(log.names["bodies"], log.states.body_q.transpose(1, 0, 2), strict=True):
            axes.plot(way[:, 0], way[:, 1], lw=1.2, label=name)
        _legend(axes)
        labels = VIEWS["top"].labels
    else:
        view = view or natural_view(plant.layout, log.states.body_q)
        _draw_scene(ScenePicture(axes, plant, VIEWS[view]), log, plant, snapshots)
        labels = VIEWS[view].labels
    axes.set_aspect("equal")
    axes.autoscale_view()
    if labels is None:
        axes.set_axis_off()
    else:
        axes.set_xlabel(labels[0])
        axes.set_ylabel(labels[1])


def _draw_scene(picture: ScenePicture, log: RunLog, plant: Plant, snapshots: int) -> None:
    picture.ground()
    picture.solid(log.states.body_q[-1], ("obstacle",))
    moments = np.linspace(0, len(log.states) - 1, snapshots).round().astype(int)
    for n, i in enumerate(moments[:-1]):
        picture.outlines(log.states.body_q[i], ("object", "robot"), alpha=0.08 + 0.3 * n / len(moments))
    picture.solid(log.states.body_q[-1], ("object", "robot"))
    for entity in plant.layout.entities:
        if entity.bodies:
            color = [0.7 * value for value in COLORS[entity.kind]]
            picture.path(log.states.body_q[:, entity.bodies[-1], :3], color=color, lw=1.2)
    if plant.scene.goal is not None:
        picture.path(plant.task.pose(GOAL)[None, :3], marker="*", color="tab:green", ms=16, zorder=5)


def draw_costs(axes: Axes, log: RunLog) -> None:
    """Draw what each term cost over time, each curve by its name."""
    time = log.states.time[:-1]
    for name, values in zip(log.names["terms"], log.of_plans("terms").T, strict=True):
        axes.plot(time, values, lw=1.0, label=name)
    axes.plot(time, log.of_plans("cost"), color="k", lw=1.5, label="sum")
    axes.set_ylabel("cost of the best sample")


def draw_forces(axes: Axes, log: RunLog) -> None:
    """Draw the contact force of each pair over time."""
    for name, force in zip(log.names["pairs"], np.linalg.norm(log.states.contact_force, axis=-1).T, strict=True):
        axes.plot(log.states.time, force, lw=1.0, label=name)
    axes.set_ylabel("contact force [N]")


def draw_plan_times(axes: Axes, log: RunLog, scene: Scene | None) -> None:
    """Draw the wall time of every plan, and what real time allows."""
    axes.plot(log.states.time[:-1], log.controls.plan_ms, ".", ms=3, color="tab:blue", label="plan")
    if scene is not None:
        axes.axhline(1e3 * scene.timing.control_dt, color="tab:red", lw=1.0, ls="--", label="one control")
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel("plan time [ms]")


def draw_foresight(axes: Axes, log: RunLog, foreseen: Foresight) -> None:
    """Draw how far the states that the planner foresaw are from those that came, as a share of their movement."""
    axes.plot(foreseen.time, 100.0 * foreseen.errors, color="tab:blue", lw=1.0, label="state after 0.2 s")
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel("error of the prediction [% of the movement]")


def _foresight(log: RunLog, scene: Scene, terms: Sequence[UserTerm]) -> Foresight | None:
    """Return what a run's planner foresaw; None where log or engine do not tell, or a term is not here."""
    planned = log.origin is not None and "joint_q" in (log.plans.dtype.names or ()) and len(log.controls)
    if log.real_time or not planned or not takes_mujoco_steps(log.origin["engine"], scene):
        return None
    origin, steps = log.origin, logged_steps(log, scene)
    try:
        planned = {"engine": origin["engine"], "device": origin["device"], "terms": terms}
        return foresee(scene, compile_scene(scene), steps, seed=origin["seed"], **planned)
    except SceneError:
        return None


def _curves(log: RunLog, draw, *arguments: object) -> Figure:
    """A figure of curves over time."""
    figure = Figure(figsize=(8, 4), dpi=DPI)
    axes = figure.add_subplot()
    draw(axes, log, *arguments)
    axes.set_xlim(log.states.time[0], log.states.time[-1])
    axes.set_xlabel("time [s]")
    _legend(axes)
    return figure


def _rows(log: RunLog, names: Sequence[str], values: np.ndarray) -> Figure:
    """A figure with a row of its own for every number over time."""
    figure = Figure(figsize=(8, 1.0 + 1.2 * len(names)), dpi=DPI)
    rows = figure.subplots(len(names), sharex=True, squeeze=False)[:, 0]
    for axes, name, column in zip(rows, names, values.T, strict=True):
        axes.plot(log.states.time[: len(column)], column, lw=1.0, drawstyle="steps-post")
        axes.set_ylabel(name, rotation=0, ha="right", va="center", fontsize="small")
        axes.grid(alpha=0.3)
    rows[-1].set_xlim(log.states.time[0], log.states.time[-1])
    rows[-1].set_xlabel("time [s]")
    return figure


def _errors(log: RunLog, scene: Scene | None) -> Figure:
    """A figure of how far the goal is, with what counts as success."""
    figure = _rows(log, log.names["errors"], log.states.goal_error)
    for axes, name in zip(figure.axes, log.names["errors"], strict=True):
        tolerance = getattr(scene and scene.success, "distance" if name == "position" else name, None)
        if tolerance is not None:
            axes.axhline(tolerance, color="tab:green", lw=1.0, ls="--")
        axes.set_ylabel(f"{name} [{'m' if name == 'position' else 'rad'}]", rotation=90, ha="center", va="bottom")
        axes.set_ylim(bottom=0.0)
    return figure


def _legend(axes: Axes) -> None:
    axes.legend(fontsize="x-small", loc="center left", bbox_to_anchor=(1.0, 0.5))
