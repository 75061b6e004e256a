# SPDX-License-Identifier: Apache-2.0
"""Figures of a run, from its log; needs matplotlib (extra ``plot``)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from ...physics.runtime.files import writing
from ...scene.errors import SceneError
from ...scene.model.compiled import compile_scene
from ..doctor.foresight import Foresight, foresee, logged_steps, takes_mujoco_steps
from .replay import logged_scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ...cost.term import UserTerm
    from ...loop.log.run_log import RunLog
    from ...scene.schema import Scene

DPI = 110
PICTURES = (".png", ".pdf", ".svg")
"""Endings of pictures that are written."""
HIDES = 20.0
"""Times that a curve is as high as all others at nearly all times, from which they are drawn on a logarithmic axis."""


def plot_log(
    log: RunLog, folder: str | Path, *, title: str = "", scene: Scene | None = None, terms: Sequence[UserTerm] = ()
) -> list[Path]:
    """Write figures (PNG) of a run, and all its numbers (CSV).

    Args:
        log: The run.
        folder: Folder for the files; made if it is not there.
        title: What the figures' titles begin with.
        scene: The run's scene; that of the log if None.
        terms: Users' own cost terms that the scene's success or phases name.

    Returns:
        The files.

    Raises:
        SceneError: If the scene of the log cannot be built here.
        OSError: If a file cannot be written.
    """
    folder = Path(folder)
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    if scene is None and log.origin is not None:
        scene = logged_scene(log)
    log.save(folder / "history.csv")
    written = [folder / "history.csv"]
    for name, figure in figures(log, scene, terms):
        figure.axes[0].set_title(": ".join(filter(None, (title, name.replace("_", " ")))))
        with writing(folder / f"{name}.png"):
            figure.savefig(folder / f"{name}.png", bbox_inches="tight")
        written.append(folder / f"{name}.png")
    return written


def plot_overview(log: RunLog, path: Path, *, title: str = "") -> None:
    """Write one picture of a run: the ways of its bodies, and costs, controls and errors over time.

    Args:
        log: The run.
        path: File, one of :data:`PICTURES`.
        title: Title of the picture.

    Raises:
        OSError: If the file cannot be written.
    """
    time, names = log.states.time, log.names
    curves = [("controls", log.controls.control, names["controls"])] * bool(len(log.controls))
    curves += [("goal error [m or rad]", log.states.goal_error, names["errors"])] * bool(names["errors"])
    costs = bool(names["terms"] and len(log.controls))
    figure = Figure(figsize=(15, 7), dpi=DPI, layout="constrained")
    grid = figure.add_gridspec(max(len(curves) + costs, 1), 2)
    draw_ways(figure.add_subplot(grid[:, 0]), log)
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
    with writing(path):
        figure.savefig(path)


def figures(log: RunLog, scene: Scene | None, terms: Sequence[UserTerm] = ()) -> Iterator[tuple[str, Figure]]:
    """Name and figure of everything that a log has: path, costs, controls, plan times, errors, forces, ticks."""
    controls, names = log.controls, log.names
    figure = Figure(figsize=(7, 7), dpi=DPI)
    draw_ways(figure.add_subplot(), log)
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


def draw_ways(axes: Axes, log: RunLog) -> None:
    """Draw where every body went, seen from above."""
    for name, way in zip(log.names["bodies"], log.states.body_q.transpose(1, 0, 2), strict=True):
        axes.plot(way[:, 0], way[:, 1], lw=1.2, label=name)
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    _legend(axes)


def draw_costs(axes: Axes, log: RunLog) -> None:
    """Draw what each term cost over time, each curve by its name, so that none hides the others."""
    time, terms = log.states.time[:-1], log.of_plans("terms")
    for name, values in zip(log.names["terms"], terms.T, strict=True):
        axes.plot(time, values, lw=1.0, label=name)
    axes.plot(time, log.of_plans("cost"), color="k", lw=1.5, label="sum")
    axes.set_ylabel("cost of the best sample")
    size = np.abs(terms[np.isfinite(terms).all(axis=1)])
    if not len(size) or size.shape[1] < 2:
        return
    most = size[:, np.arange(size.shape[1]) != size.max(axis=0).argmax()].sum(axis=1)
    others = float(np.percentile(most, 95.0))
    if 0.0 < HIDES * others < size.max():
        axes.set_yscale("symlog", linthresh=0.01 * others)


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
    """Draw how far predicted states are from those that came, as a share of their movement."""
    axes.plot(foreseen.time, 100.0 * foreseen.errors, color="tab:blue", lw=1.0, label="state after 0.2 s")
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel("error of the prediction [% of the movement]")


def _foresight(log: RunLog, scene: Scene, terms: Sequence[UserTerm]) -> Foresight | None:
    """Return what a run's planner predicted; None where log or engine do not tell, or a term is not here."""
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
    figure = Figure(figsize=(8, 4), dpi=DPI)
    axes = figure.add_subplot()
    draw(axes, log, *arguments)
    axes.set_xlim(log.states.time[0], log.states.time[-1])
    axes.set_xlabel("time [s]")
    _legend(axes)
    return figure


def _rows(log: RunLog, names: Sequence[str], values: np.ndarray) -> Figure:
    """A figure with its own row for every number over time."""
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
