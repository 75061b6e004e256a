# SPDX-License-Identifier: Apache-2.0
r"""Time whole plans of the engine ``fused`` beside the goals set for it, all of a machine's in one command.

    python tools/bench.py plans --json out.json                  # every row that this machine can measure
    python tools/bench.py plans --only push_t humanoid_stand --no-floor
    python tools/bench.py plans --on gpu --limit 40 --json gpu.json
    python tools/bench.py plans --small --plans 5                # does everything run here?

A plan is timed from observation to command, in closed loop from the scene's start; the first ten are left out. Then
come, as the floor, the same physics alone by the program that stands for today's best: a bare call of
``mujoco.rollout`` on as many cores, or the bare CUDA graph of MuJoCo Warp's steps, from states of the same run, and
whole plans on those engines. Besides: physics on one core against ``mujoco.rollout``, and of 8192 worlds on a GPU
against MuJoCo Warp.

Every row has at most ``--limit`` seconds, and all of them ``--budget``; a row that crashes or takes longer is told so
and ends no other. Results are written after every row. Rows of fewer cores than there are run on so many.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table
from shared.files import write_json

from benches.goals.rows import PLAN, Row, rows_here
from benches.goals.worker import Worker

_FLOOR = {"mujoco_warp": "MuJoCo Warp's graph", "mujoco": "mujoco.rollout"}


def main(arguments: list[str]) -> None:
    """Measure row by row, tell and write what came of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="scenes or models")
    parser.add_argument("--on", choices=("all", "cpu", "gpu"), default="all", help="devices (default all there are)")
    parser.add_argument("--plans", type=int, default=100, help="timed plans of a row (default 100)")
    parser.add_argument("--floor", action=argparse.BooleanOptionalAction, default=True, help="measure the floor, too")
    parser.add_argument("--limit", type=float, default=60.0, help="longest time of a row [s] (default 60)")
    parser.add_argument("--budget", type=float, default=570.0, help="longest time of all rows [s] (default 570)")
    parser.add_argument("--small", action="store_true", help="tiny sizes; with --on gpu also without one")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    from shared.machine import machine

    from warpmpc.cli.setup import start_warp

    start_warp()

    here = machine()
    rows = [
        row
        for row in rows_here(here, options.on, pretend=options.small and options.on == "gpu")
        if not options.only or row.scene in options.only
    ]
    settings = {"plans": options.plans, "floor": options.floor, "small": options.small}
    results: list[dict] = []
    console, began = Console(width=None if os.isatty(1) else 150), time.perf_counter()
    with Worker() as worker:
        for i, row in enumerate(rows):
            left = options.budget - (time.perf_counter() - began)
            console.print(f"[{i + 1}/{len(rows)}] {row.title} on {row.where}", highlight=False, markup=False)
            results.append(_measure(worker, row, settings, min(options.limit, left)))
            console.print(f"    {told(results[-1])}", highlight=False, markup=False)
            if options.json:
                report = {"date": time.strftime("%Y-%m-%d"), "machine": here, "settings": settings, "rows": results}
                write_json(options.json, report)
    show(results, console)
    after = machine()
    load = f"load {here['load'][0]:.1f} before, {after['load'][0]:.1f} after"
    console.print(f"{load}, {here['cores']} cores, {here['cpu']}, GPUs: {', '.join(here['gpus']) or 'none'}")


def _measure(worker: Worker, row: Row, settings: dict, seconds: float) -> dict:
    """One row in the worker process, and how long it took."""
    begin = time.perf_counter()
    found = worker.call(row, settings, seconds) if seconds > 5.0 else {"error": "left out: no time"}
    return row.to_json() | found | {"took_s": time.perf_counter() - begin}


def told(result: dict) -> str:
    """A row's figures in one line."""
    parts = []
    if "plan_ms" in result:
        parts.append(f"{_pair(result['plan_ms'])} ms (p50 / p99 of {result['plans']})")
    if "ratio" in result:
        parts.append(f"{result['ratio']:.1f} times as fast, {result['fused_us']:.3g} µs a world-step")
    parts.append(verdict(result))
    if "floor_ms" in result:
        other = result["other"]
        parts.append(
            f"{_FLOOR[other]} alone {_pair(result['floor_ms'])}, plans of {other} {_pair(result['other_plan_ms'])}"
        )
    parts.append(f"took {result['took_s']:.0f} s")
    return ", ".join(filter(None, parts))


def verdict(result: dict) -> str:
    """Whether the goal was met, by the median, and an error if there was one."""
    error = f"FAILED: {result['error']}" if "error" in result else ""
    value = result.get("plan_ms", {}).get("p50") if result["kind"] == PLAN else result.get("ratio")
    goal = result["goal"]
    if value is None or goal is None:
        return error
    good = value <= goal if result["kind"] == PLAN else value >= goal
    by = abs(value - goal) / goal
    text = f"goal {goal:g}: {'met' if good else f'missed by {100 * by:.0f} %'}"
    return f"{text} ({error})" if error else text


def show(results: list[dict], console: Console) -> None:
    """All rows in one table."""
    heads = ("row", "on", "p50 / p99 in ms, or ratio", "goal", "physics alone", "other engine's plan")
    table = Table(*heads, box=None)
    for r in results:
        figure = _pair(r["plan_ms"]) if "plan_ms" in r else f"{r['ratio']:.1f} ×" if "ratio" in r else "-"
        others = [_pair(r[key]) if key in r else "-" for key in ("floor_ms", "other_plan_ms")]
        table.add_row(r["title"], r["where"], figure, verdict(r), *others)
    console.print(table)


def _pair(times: dict[str, float]) -> str:
    return f"{times['p50']:.3g} / {times['p99']:.3g}"
