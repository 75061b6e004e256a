# SPDX-License-Identifier: Apache-2.0
"""Tables on the terminal: scenes, cost terms, what a check built, results of episodes."""

from __future__ import annotations

import math
import os
import statistics
from typing import TYPE_CHECKING, TextIO

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from ..scene.errors import some
from ..scene.load import load_scene, shipped_scenes, variants
from ..scene.schema_planner import PRESETS
from ..scene.waypoints import runs_of
from .joint_table import joint_table
from .summary import summary
from .words import failure_words, goal_words, number_words, phase_words, planner_words, preset_words, shape_words

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..controller.rollout import Rollout
    from ..doctor.diagnose import Diagnosis
    from ..doctor.steps import StepError
    from ..model.layout import Layout
    from ..run.episode import Episode
    from ..run.result import EpisodeResult

PIPE_WIDTH = 160
"""Width of tables that go into a pipe or file, unless ``COLUMNS`` says another."""

VERDICTS = 2
"""Failed episodes whose whole verdict is printed: further ones mostly repeat it; ``--json`` has all."""

_UNITS = {
    "velocity": ("m/s", "rad/s"),
    "acceleration": ("m/s²", "rad/s²"),
    "position": ("m", "rad"),
    "effort": ("N", "N·m"),
}
"""Unit of a control by drive mode, along a linear and an angular axis."""


def _console(out: TextIO | None = None) -> Console:
    console = Console(file=out, highlight=False)
    if not console.is_terminal and not os.environ.get("COLUMNS", "").isdigit():
        console.width = PIPE_WIDTH
    return console


def _show(console: Console, table: Table) -> None:
    """Print a table whose words and numbers are whole, also where that takes more than the width there is."""
    for column in table.columns:
        cells = [str(cell) for cell in (column.header, *column.cells)]
        column.min_width = max(
            len(part) for cell in cells for part in (cell.split("\n") if column.no_wrap else cell.split() or [""])
        )
    least = 1 + sum(column.min_width + 2 for column in table.columns)
    before, console.width = console.width, max(console.width, least)
    console.print(table)
    console.width = before


def _table(*columns: str, right: Sequence[str] = (), title: str | None = None) -> Table:
    table = Table(box=box.SIMPLE_HEAD, title=title, title_justify="left", pad_edge=False, padding=(0, 1, 0, 0))
    for name in columns:
        table.add_column(Text(name), justify="right" if name in right else "left", no_wrap=name in right)
    return table


def print_scenes() -> None:
    """Print the scenes that come with warpmpc.

    Raises:
        SceneError: If one of them is broken.
    """
    table = _table("scene", "variants", "robots", "samples × horizon", "plans/s", "title", right=["plans/s"])
    for name in shipped_scenes():
        scene = load_scene(name)
        planner = scene.planner
        table.add_row(
            Text(name, style="bold"),
            Text(", ".join(variants(name)) or "-"),
            Text(", ".join(robot.name for robot in scene.robot)),
            f"{planner.samples} × {planner.horizon}",
            f"{1.0 / scene.timing.control_dt:g}",
            Text(scene.title),
        )
    _show(_console(), table)


def print_check(
    episode: Episode,
    out: TextIO,
    *,
    plan_ms: float | None = None,
    coarse: StepError | None = None,
    advice: Sequence[str] = (),
) -> None:
    """Print what an episode is built of, and what is hardly meant; its controller has made a plan.

    Args:
        episode: The episode.
        out: Where to.
        plan_ms: Wall time of a plan, the median of several [ms]; that of the last if None.
        coarse: Error that the planner's physics step makes.
        advice: Sentences on what is hardly meant.
    """
    # slow to import, and lists need no physics
    from ..doctor.approach import probes
    from ..doctor.contact_time import contact_time
    from ..doctor.subject import Subject
    from ..engine.registry import physics_steps
    from ..model.memory import size
    from ..model.trajectory import Trajectory

    scene, controller = episode.scene, episode.controller
    layout, rollouts = controller.layout, probes(controller)
    console = _console(out)
    facts = Table.grid(padding=(0, 2))
    facts.add_column(style="bold", no_wrap=True)
    facts.add_column()

    def fact(name: str, text: str) -> None:
        facts.add_row(name, Text(text))

    fact("scene", scene.name + (f", variant {scene.variant}" if scene.variant else ""))
    if scene.title:
        fact("", scene.title)
    if scene.path:
        fact("file", str(scene.path))
    if episode.drawn:
        drawn = ", ".join(f"{key} = {number_words(value)}" for key, value in episode.drawn.items())
        fact(f"drawn, seed {episode.seed}", drawn)
    for robot in scene.robot:
        entity = layout.entity(robot.name)
        dofs = sum(int(layout.joint_dof_dim[j].sum()) for j in entity.joints)
        fact("robot", f"{robot.name}: {dofs} DoF, {len(entity.bodies)} links, from {robot.asset}")
    for note in controller.compiled.notes:
        fact("as written", note)
    for line in controller.compiled.repaired:
        fact("repaired", line)
    for item in scene.object:
        fact("object", f"{item.name}: {shape_words(item)}, {item.mass:g} kg")
    for item in scene.obstacle:
        fact("obstacle", f"{item.name}: {shape_words(item)} at {number_words(item.position)}")
    fact("frames", ", ".join(layout.frame_name))
    fact("goal", goal_words(scene))
    for failure in scene.failure:
        fact("failure", failure_words(failure))
    for target in scene.target:
        fact("target", f"{target.name} at {number_words(target.position)} m")
    if scene.scalar:
        fact("scalars", ", ".join(f"{name} = {number_words(value)}" for name, value in scene.scalar.items()))
    for name, last in runs_of(phase.name for phase in scene.phase):
        phase = next(phase for phase in scene.phase if phase.name == name)
        fact("phase", (name if last == name else f"{name} to {last}") + phase_words(phase))
    fact("planner", planner_words(scene))
    if scene.planner.method in PRESETS:
        fact("preset", f"{scene.planner.method} means {preset_words(scene.planner.method)}, unless the scene says else")
    shape = controller.shape
    substeps = physics_steps(controller.engine.name, scene, controller.compiled, controller.plan_step.grid).count
    steps = shape.worlds * sum(substeps)
    each = str(substeps[0]) if len(set(substeps)) == 1 else f"{min(substeps)} to {max(substeps)}"
    fact("engine", f"{controller.engine.name} on {controller.device}, seed {episode.seed}")
    fact(
        "rollouts", f"{shape.worlds} worlds × {shape.horizon} controls × {each} substeps = {steps} physics steps a plan"
    )
    if coarse is not None:
        fact("physics step", str(coarse))
    fact("contacts", contact_time(Subject(scene, controller.compiled), rollouts))
    if controller.plan_step.refiner:
        fact("derivatives", controller.plan_step.refiner.summary)
    ahead = float(controller.plan_step.grid.t[-1])
    fact("time", f"a control lasts {1e3 * scene.timing.control_dt:g} ms, a plan looks {ahead:g} s ahead")
    fact("memory", f"{size(Trajectory.bytes(shape, layout, len(controller.costs.pairs)))} if every rollout is recorded")
    took = f"{controller.info.plan_ms if plan_ms is None else plan_ms:.1f} ms"
    took += ", the median of several along a run" * (plan_ms is not None)
    fact("one plan took", f"{took} on this machine")
    for sentence in advice:
        fact("is it meant?", sentence)
    console.print(facts)
    _show(console, joint_table(layout))
    _show(console, _controls(layout))
    _show(console, _costs(episode))
    if rollouts and (episode.scene.success is not None or episode.scene.phase):
        _show(console, _conditions(episode, rollouts))


def _controls(layout: Layout) -> Table:
    table = _table(
        "control", "drive", "lower", "upper", "unit", "effort limit", right=["lower", "upper", "effort limit"]
    )
    for i, name in enumerate(layout.control_name):
        rows = np.flatnonzero(layout.actuator_matrix[:, i])
        if not len(rows):  # an actuator of an MJCF file
            lower, upper = f"{layout.control_lower[i]:g}", f"{layout.control_upper[i]:g}"
            table.add_row(name, "the file's own", lower, upper, "", "")
            continue
        mode, linear = layout.actuator_mode[rows[0]], _is_linear(layout, int(layout.actuator_dof[rows[0]]))
        effort = f"{layout.actuator_effort[rows[0]]:g} {_UNITS['effort'][not linear]}"
        if len(rows) > 1:  # speeds of a base with two wheels
            mode, linear = "diff_drive", name.endswith("/v")
        unit = _UNITS["velocity" if mode == "diff_drive" else mode][not linear]
        table.add_row(name, mode, f"{layout.control_lower[i]:g}", f"{layout.control_upper[i]:g}", unit, effort)
    return table


def _is_linear(layout: Layout, dof: int) -> bool:
    """Return whether a velocity coordinate belongs to a linear axis."""
    joint = int(np.flatnonzero(layout.joint_qd_start <= dof)[-1])
    return dof - int(layout.joint_qd_start[joint]) < int(layout.joint_dof_dim[joint, 0])


def _costs(episode: Episode) -> Table:
    from ..doctor.control import term_costs, told_apart

    right = ["weight", "best sample", "tells apart"]
    table = _table("cost", "term", "weight", "best sample", "tells apart", "keys", right=right)
    controller = episode.controller
    costs = term_costs(controller)
    apart = told_apart(costs)
    share = apart / max(apart.sum(), 1e-30)
    for label, cost, part in zip(controller.costs.labels, episode.scene.cost, share, strict=True):
        keys = ", ".join(f"{key} = {number_words(value)}" for key, value in cost.params.items())
        weight, best = f"{float(controller.task[label]):g}", f"{controller.info.terms[label]:.4g}"
        table.add_row(Text(label), Text(cost.term), weight, best, f"{part:.0%}" if part else "same in all", Text(keys))
    table.caption = "tells apart: share of a term in what the costs of the first plan's samples differ by"
    if len(costs) > 1 and not share.all():
        table.caption += (
            "\nsame in all: as it should be for contacts and limits that are far away; a term that leads to the goal "
            "needs a longer planner.lookahead, more planner.noise.sigma, or names of what controls move"
        )
    table.caption_justify = "left"
    return table


def _conditions(episode: Episode, rollouts: list[Rollout]) -> Table:
    from ..doctor.approach import approaches

    right = ["start", "wanted", "nearest sample"]
    table = _table("success waits for", "start", "wanted", "nearest sample", "", right=right)
    found = approaches(rollouts, episode.plant.monitor)
    for item in found:
        start, bound = item.start, f"{'≥' if item.start.above else '≤'} {item.start.bound:.4g}"
        nearer = "" if item.nearer else "no nearer"
        table.add_row(Text(start.name), f"{start.value:.4g}", bound, f"{item.best.value:.4g}", nearer)
    if not all(item.nearer for item in found):
        table.caption = (
            "no nearer: as it should be where something has to be reached or grasped first; else look further ahead "
            "(planner.lookahead) or raise planner.noise.sigma"
        )
        table.caption_justify = "left"
    return table


def print_results(results: Sequence[EpisodeResult], out: TextIO) -> None:
    """Print one row per episode and a line that sums them up."""
    every = {
        "seed": [str(r.seed) for r in results],
        "result": [Text(r.reason, style="green" if r.passed else "red") for r in results],
        "reached": ["-" if r.reached is None else str(r.reached) for r in results],
        "time\n[s]": [f"{r.sim_time:.2f}" for r in results],
        "mean cost": ["-" if r.success is not None else f"{r.mean_cost:.4g}" for r in results],
        _error_heading(results): [_metres(_position(r)) for r in results],
        "yaw\n[rad]": [_metres(r.yaw_error) for r in results],
        "peak force\n[N]": [f"{r.max_force:.1f}" for r in results],
        "contact\n[s]": [f"{r.time_in_contact:.2f}" for r in results],
        "plan p50\n[ms]": [_ms(r.plan_ms["p50"]) for r in results],
        "p99\n[ms]": [_ms(r.plan_ms["p99"]) for r in results],
        "safe\ncommands": [str(r.fallbacks or "-") for r in results],
    }
    columns = {name: cells for name, cells in every.items() if any(str(cell) != "-" for cell in cells)}
    table = _table(*columns, right=[name for name in columns if name != "result"], title=_title(results[0]))
    for row in zip(*columns.values(), strict=True):
        table.add_row(*row)
    console = _console(out)
    _show(console, table)
    console.print(summary(results), markup=False)
    print_verdicts(results, console)


def print_verdicts(results: Sequence[EpisodeResult], console: Console, *, outcomes: bool = True) -> None:
    """Print why episodes failed: a line for each where they are many, and what to try for the first.

    Args:
        results: Results of all episodes.
        console: Where to.
        outcomes: Whether these lines say how each episode ended.
    """
    failed = [result for result in results if result.verdict]
    if len(failed) > VERDICTS:
        table = _table("seed", *["result"] * outcomes, "why it failed", right=["seed"])
        for result in failed:
            table.add_row(str(result.seed), *[Text(result.reason)] * outcomes, Text(in_short(result.verdict)))
        _show(console, table)
    for result in failed[:VERDICTS]:
        console.print(f"why seed {result.seed} did not succeed:", markup=False)
        for sentence in result.verdict:
            console.print(f"  - {sentence}", markup=False, soft_wrap=True)


def in_short(verdict: Sequence[str]) -> str:
    """The first cause that a verdict names, without its cure; else what was not met."""
    causes = [sentence.split(": ")[0] for sentence in verdict if not sentence.startswith("not met")]
    return causes[0] if causes else verdict[0]


def print_diagnosis(title: str, found: Diagnosis, left_out: Sequence[str], out: TextIO) -> None:
    """Print which changes of a run's predictions were tried, and the cause of their error."""
    table = _table("changed in the prediction", "error", "with it", right=["error", "with it"], title=title)
    for trial in found.trials:
        style = "green" if trial.helps else ""
        table.add_row(Text(trial.cause, style=style), f"{trial.before:.1%}", f"{trial.after:.1%}")
    console = _console(out)
    console.print(table)
    console.print(
        "error: of the state 0.2 s after a plan, as a share of how far it moved; the plan's cost until then is "
        f"{found.cost:.0%} off",
        markup=False,
    )
    for reason in left_out:
        console.print(f"not tried: {reason}", markup=False, soft_wrap=True)
    console.print(found.sentence, markup=False, soft_wrap=True)


def print_batch(results: Sequence[EpisodeResult], out: TextIO) -> None:
    """Print what became of many episodes that ran at once: one row per way they ended, plan times, and a sum."""
    envs, plans = results[0].envs, [r.plan_ms for r in results if not math.isnan(r.plan_ms["p50"])]
    p50 = statistics.median(plan["p50"] for plan in plans) if plans else math.nan
    longest = max((plan["max"] for plan in plans), default=math.nan)
    table = _table(
        "result",
        "episodes",
        "mean time\n[s]",
        _error_heading(results),
        "contact\n[s]",
        "seeds",
        right=["episodes", "mean time\n[s]", _error_heading(results), "contact\n[s]"],
        title=_title(results[0]),
    )
    for reason in sorted({r.reason for r in results}, key=lambda reason: reason != "goal reached"):
        group = sorted((r for r in results if r.reason == reason), key=lambda r: r.seed)
        table.add_row(
            Text(reason, style="green" if group[0].passed else "red"),
            str(len(group)),
            f"{statistics.mean(r.sim_time for r in group):.2f}",
            _metres(None if _position(group[0]) is None else statistics.mean(map(_position, group))),
            f"{statistics.mean(r.time_in_contact for r in group):.2f}",
            "" if group[0].passed else some([str(r.seed) for r in group], most=12),
        )
    console = _console(out)
    _show(console, table)
    safe = sum(r.fallbacks for r in results)
    console.print(
        f"plan of {envs} environments: p50 {_ms(p50)} ms, {_ms(p50 / envs)} ms each; longest {_ms(longest)} ms"
        + (f"\n{safe} safe commands" if safe else ""),
        markup=False,
    )
    share = f"{100.0 * sum(r.passed for r in results) / len(results):.1f} %: " if results[0].success is not None else ""
    console.print(share + summary(results), markup=False)
    print_verdicts(results, console, outcomes=False)


def _title(result: EpisodeResult) -> str:
    name = result.scene + (f":{result.variant}" if result.variant else "")
    return f"{name}, {result.engine} on {result.device}"


def _error_heading(results: Sequence[EpisodeResult]) -> str:
    """Heading of the column of final errors, as success counts them."""
    return "distance\n[m]" if results[0].axis_error is None else "worst axis\n[m]"


def _position(result: EpisodeResult) -> float | None:
    return result.position_error if result.axis_error is None else result.axis_error


def _metres(value: float | None) -> str:
    """Error [m] or [rad]; a dash without one."""
    return "-" if value is None else f"{value:.3f}"


def _ms(value: float) -> str:
    """A wall time [ms]; a dash without a plan."""
    return "-" if math.isnan(value) else f"{value:.1f}"
