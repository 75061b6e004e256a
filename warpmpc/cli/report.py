# SPDX-License-Identifier: Apache-2.0
"""Tables on the terminal: scenes, results of episodes, a diagnosis."""

from __future__ import annotations

import math
import os
import statistics
from typing import TYPE_CHECKING, Any, TextIO

from rich import box
from rich.table import Table
from rich.text import Text

from ..scene.errors import some
from ..scene.load import load_scene, shipped_scenes, variants
from ..scene.model.state import PROPOSERS
from .terminal import screen

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

    from ..extras.doctor.diagnose import Diagnosis
    from ..loop.run.result import EpisodeResult

PIPE_WIDTH = 160
"""Width of tables that go into a pipe or file, unless ``COLUMNS`` says another."""
VERDICTS = 2
"""Failed episodes whose whole verdict is printed: further ones mostly repeat it; ``--json`` has all."""


def console_of(out: TextIO | None = None) -> Console:
    """A console for tables."""
    console = screen(out)
    if not console.is_terminal and not os.environ.get("COLUMNS", "").isdigit():
        console.width = PIPE_WIDTH
    return console


def show_table(console: Console, table: Table) -> None:
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


def make_table(*columns: str, right: Sequence[str] = (), title: str | None = None) -> Table:
    """A table without rows; numbers are to the right."""
    table = Table(box=box.SIMPLE_HEAD, title=title, title_justify="left", pad_edge=False, padding=(0, 1, 0, 0))
    for name in columns:
        table.add_column(Text(name), justify="right" if name in right else "left", no_wrap=name in right)
    return table


def print_scenes() -> None:
    """Print the scenes that come with warpmpc.

    Raises:
        SceneError: If one of them is broken.
    """
    table = make_table("scene", "variants", "robots", "samples × horizon", "plans/s", "title", right=["plans/s"])
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
    show_table(console_of(), table)


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
        "peak force\n[N]": ["-" if r.max_force is None else f"{r.max_force:.1f}" for r in results],
        "contact\n[s]": [_contact([r]) for r in results],
        "plan p50\n[ms]": [_ms(r.plan_ms["p50"]) for r in results],
        "p99\n[ms]": [_ms(r.plan_ms["p99"]) for r in results],
        "safe\ncommands": [str(r.fallbacks or "-") for r in results],
    }
    console = console_of(out)
    show_table(console, _table_of(every, left=["result"], title=_title(results[0])))
    console.print(summary(results))
    if proposed := proposers(results):
        console.print(proposed)
    print_verdicts(results, console)


def proposers(results: Sequence[EpisodeResult]) -> str:
    """Where the plans of episodes came from; empty without derivatives."""
    told = [result.proposers for result in results if result.proposers]
    if not told:
        return ""
    share = {name: statistics.mean(own.get(name, 0.0) for own in told) for name in (*PROPOSERS, "lowered")}
    words = ", ".join(f"{name} {share[name]:.0%}" for name in PROPOSERS if share[name])
    return f"plans from: {words}; derivatives lowered the cost of {share['lowered']:.0%}"


def print_verdicts(results: Sequence[EpisodeResult], console: Console, *, outcomes: bool = True) -> None:
    """Print why episodes failed: a line for each where they are many, and what to try for the first.

    Args:
        results: Results of all episodes.
        console: Where to.
        outcomes: Whether these lines say how each episode ended.
    """
    failed = [result for result in results if result.verdict]
    if len(failed) > VERDICTS:
        table = make_table("seed", *["result"] * outcomes, "why it failed", right=["seed"])
        for result in failed:
            table.add_row(str(result.seed), *[Text(result.reason)] * outcomes, Text(in_short(result.verdict)))
        show_table(console, table)
    for result in failed[:VERDICTS]:
        console.print(f"why seed {result.seed} did not succeed:")
        for sentence in result.verdict:
            console.print(f"  - {sentence}", soft_wrap=True)
        for trial in result.tried:
            console.print(trial_words(trial), soft_wrap=True)
        if result.tried:
            console.print(best_words(result.tried), soft_wrap=True)
    if failed and not any(result.tried for result in failed):
        console.print(f"to try what may help: the same command with --seed {failed[0].seed} --advise", soft_wrap=True)


def in_short(verdict: Sequence[str]) -> str:
    """The first cause that a verdict names, without its cure; else what was not met."""
    causes = [sentence.split(": ")[0] for sentence in verdict if not sentence.startswith("not met")]
    return causes[0] if causes else verdict[0]


def print_diagnosis(title: str, found: Diagnosis, left_out: Sequence[str], out: TextIO) -> None:
    """Print which changes of a run's predictions were tried, and the cause of their error."""
    table = make_table("changed in the prediction", "error", "with it", right=["error", "with it"], title=title)
    for trial in found.trials:
        style = "green" if trial.helps else ""
        table.add_row(Text(trial.cause, style=style), f"{trial.before:.1%}", f"{trial.after:.1%}")
    console = console_of(out)
    console.print(table)
    console.print(
        "error: of the state 0.2 s after a plan, as a share of how far it moved; the plan's cost until then is "
        f"{found.cost:.0%} off",
    )
    for reason in left_out:
        console.print(f"not tried: {reason}", soft_wrap=True)
    console.print(found.sentence, soft_wrap=True)


def print_batch(results: Sequence[EpisodeResult], out: TextIO) -> None:
    """Print what became of many episodes that ran at once: one row per way they ended, plan times, and a sum."""
    envs, plans = results[0].envs, [r.plan_ms for r in results if not math.isnan(r.plan_ms["p50"])]
    p50 = statistics.median(plan["p50"] for plan in plans) if plans else math.nan
    longest = max((plan["max"] for plan in plans), default=math.nan)
    reasons = sorted({r.reason for r in results}, key=lambda reason: reason != "goal reached")
    groups = [sorted((r for r in results if r.reason == reason), key=lambda r: r.seed) for reason in reasons]
    every = {
        "result": [Text(group[0].reason, style="green" if group[0].passed else "red") for group in groups],
        "episodes": [str(len(group)) for group in groups],
        "mean time\n[s]": [f"{statistics.mean(r.sim_time for r in group):.2f}" for group in groups],
        _error_heading(results): [
            _metres(None if _position(group[0]) is None else statistics.mean(map(_position, group))) for group in groups
        ],
        "contact\n[s]": [_contact(group) for group in groups],
        "seeds": ["" if group[0].passed else some([str(r.seed) for r in group], most=12) for group in groups],
    }
    console = console_of(out)
    show_table(console, _table_of(every, left=["result", "seeds"], title=_title(results[0])))
    safe = sum(r.fallbacks for r in results)
    console.print(
        f"plan of {envs} environments: p50 {_ms(p50)} ms, {_ms(p50 / envs)} ms each; longest {_ms(longest)} ms"
        + (f"\n{safe} safe commands" if safe else ""),
    )
    share = f"{100.0 * sum(r.passed for r in results) / len(results):.1f} %: " if results[0].success is not None else ""
    console.print(share + summary(results))
    print_verdicts(results, console, outcomes=False)


def _table_of(columns: dict[str, list], *, left: Sequence[str], title: str) -> Table:
    """A table of columns by heading; those that have nothing but dashes are left out."""
    columns = {name: cells for name, cells in columns.items() if any(str(cell) != "-" for cell in cells)}
    table = make_table(*columns, right=[name for name in columns if name not in left], title=title)
    for row in zip(*columns.values(), strict=True):
        table.add_row(*row)
    return table


def _contact(results: Sequence[EpisodeResult]) -> str:
    """Mean time in contact [s]; a dash where no pair is watched."""
    times = [result.time_in_contact for result in results]
    return "-" if None in times else f"{statistics.mean(times):.2f}"


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


def summary(results: Sequence[EpisodeResult]) -> str:
    """Number of successful episodes, and the mean ± standard deviation of their times; else of their costs."""
    if results[0].success is None:
        costs = [result.mean_cost for result in results if math.isfinite(result.mean_cost)]
        text = f"{sum(r.passed for r in results)} of {len(results)} ran to the timeout{_in_a_row(results)}"
        spread = f" ± {statistics.stdev(costs):.4g}" if len(costs) > 1 else ""
        return f"{text}; mean cost {statistics.mean(costs):.4g}{spread}" if costs else text
    times = [result.time_to_goal for result in results if result.time_to_goal is not None]
    text = f"{len(times)} of {len(results)} reached the goal" + _in_a_row(results)
    if not times:
        return text
    spread = f" ± {statistics.stdev(times):.2f}" if len(times) > 1 else ""
    return f"{text}; time to goal {statistics.mean(times):.2f}{spread} s"


def _in_a_row(results: Sequence[EpisodeResult]) -> str:
    """Number of phases of a task in parts that came to their end."""
    reached = [result.reached for result in results if result.reached is not None]
    if not reached:
        return ""
    return f"; phases reached: median {statistics.median(reached):g}, {min(reached)} to {max(reached)}"


def trial_words(trial: dict[str, Any]) -> str:
    """What came of trying changes of a scene."""
    helps = {True: "helps, ", False: "does not help, ", None: ""}[trial["helped"]]
    return f"  tried: {' '.join(trial['set'])} {helps}{trial['outcome']}"


def best_words(tried: Sequence[dict[str, Any]]) -> str:
    """The change with which the goal was reached soonest, to paste."""
    reached = [trial for trial in tried if "reached_s" in trial]
    if reached:
        best = min(reached, key=lambda trial: trial["reached_s"])
        return f"  reached soonest with {' '.join(f'--set {change}' for change in best['set'])}"
    return "  none of these reached the goal" if any(trial["helped"] for trial in tried) else "  none of these helped"
