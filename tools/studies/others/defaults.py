# SPDX-License-Identifier: Apache-2.0
"""Run tasks with the planner's defaults alone: shipped scenes without their [planner], and the scenes in others.

    python tools/study.py defaults --jobs 2                          # all of them, tuning seeds 0 to 2
    python tools/study.py defaults --tasks tools/studies/others/*.toml --report "defaults, other tasks" --json out.json
    python tools/study.py defaults --tasks push_t walker --set planner.knots=8

Scenes in tools/studies/others are tasks that the defaults were not chosen on, some with models of packages: install
metaworld, gymnasium-robotics and others for these (pip install --no-deps). With ``--own-planner`` scenes keep their
planners, as ``FILE.toml:advised`` does: a task of others with what `check` and the verdict advised.
A task counts as solved when two thirds of its seeds reach the goal. --report draws seeds that nobody has looked at
(tools/seeds.toml).
"""

from __future__ import annotations

import argparse
import tomllib
from concurrent.futures import as_completed
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from shared.files import write_json
from shared.intervals import mean
from shared.machine import machine
from shared.progress import Bar
from shared.seeds import draw

import warpmpc
from warpmpc.cli.setup import start_warp
from warpmpc.loop.run.episode import run_episode
from warpmpc.loop.run.workers import FORMS, check_jobs, open_workers
from warpmpc.scene.origin import code_digest
from warpmpc.scene.schema import Scene

OTHERS = Path(__file__).parent
SHIPPED = (
    *("pendulum", "cartpole_swingup", "acrobot", "quadrotor", "point_reach", "panda_reach", "storm_reach"),
    *("cylinder_push", "push_t", "omni_push_box", "diff_push_box", "panda_push", "mobile_pick", "box_carry"),
    *("walker", "humanoid_stand", "quadruped_walk", "go2_walk", "storm_hold_orientation"),
)
"""Shipped scenes on which the defaults were chosen."""


def bare(task: str, settings: list[str], *, own: bool) -> Scene:
    """The scene of a task with no planner's keys but those of ``settings``, or with its own, too, on one thread."""
    if own or ".toml:" in task:
        return warpmpc.load_scene(task, overrides=["engine.threads=1", *settings])
    scene = warpmpc.load_scene(task, overrides=["engine.threads=1"])
    planner = tomllib.loads("\n".join(text.removeprefix("planner.") for text in settings))
    return Scene.model_validate({**scene.model_dump(exclude_unset=True), "planner": planner, "path": scene.path})


def _label(task: str) -> str:
    return Path(task).name.replace(".toml", "")


def play(task: str, settings: list[str], seed: int, own: bool) -> dict:
    """One episode: what became of it."""
    row = {"task": _label(task), "seed": seed}
    try:
        result = run_episode(bare(task, settings, own=own), seed=seed, engine="fused", device="cpu")
    except warpmpc.SceneError as error:
        return {**row, "success": False, "reason": str(error)}
    out = {"success": result.success, "reason": result.reason, "seconds": result.sim_time}
    return {**row, **out, "plan_ms": result.plan_ms["p50"], "verdict": list(result.verdict)}


def table(rows: list[dict]) -> list[list[str]]:
    """Cells of each task: episodes that reached the goal, time to it, median plan time."""
    out = []
    for task in dict.fromkeys(row["task"] for row in rows):
        own = [row for row in rows if row["task"] == task]
        times = [row["seconds"] for row in own if row["success"]]
        plan = [row["plan_ms"] for row in own if "plan_ms" in row]
        taken = "-"
        if times:
            about = mean(times)
            spread = f" ± {about.high - about.value:.2g}" if about.high is not None else ""
            taken = f"{about.value:.3g}{spread}, worst {max(times):.3g}"
        out.append([task, f"{len(times)} of {len(own)}", taken, f"{np.median(plan):.3g}" if plan else "-"])
    return out


def main(arguments: list[str]) -> int:
    """Run the episodes and print the table; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    everything = [*SHIPPED, *map(str, sorted(OTHERS.glob("*.toml")))]
    parser.add_argument("--tasks", nargs="+", default=everything, metavar="SCENE")
    parser.add_argument(
        "--set", nargs="*", default=[], metavar="planner.KEY=VALUE", help="differences from the defaults"
    )
    parser.add_argument("--own-planner", action="store_true", help="scenes keep their [planner]")
    parser.add_argument("--seeds", default="0:3", metavar="FIRST:LAST", help="tuning seeds (default 0:3)")
    parser.add_argument("--report", help="name of a report: draws its seeds, as many as --seeds has")
    parser.add_argument("--jobs", default="1", metavar="WHERE", help=f"{FORMS} (default 1)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="where the rows go")
    args = parser.parse_args(arguments)
    check_jobs(args.jobs)
    first, last = map(int, args.seeds.split(":"))
    seeds = range(first, last)
    if args.report:
        seeds = draw(args.report, code_digest())[: len(seeds)]
    workers, _ = open_workers(args.jobs, device="cpu", prepare=start_warp)
    rows, order = [], [_label(task) for task in args.tasks]
    with workers, Bar(len(args.tasks) * len(seeds)) as bar:
        jobs = [workers.submit(play, task, args.set, seed, args.own_planner) for task in args.tasks for seed in seeds]
        for future in as_completed(jobs):
            row = future.result()
            rows.append(row)
            rows.sort(key=lambda row: (order.index(row["task"]), row["seed"]))
            if args.json:  # what is done is kept, whatever happens
                made = {"machine": machine(), "code": code_digest(), "set": args.set, "own_planner": args.own_planner}
                write_json(args.json, {**made, "rows": rows})
            bar.step(f"{row['task']}, seed {row['seed']}: {row['reason']}")
    shown = Table("task", "reached the goal", "time to goal [s]", "plan [ms]")
    for cells in table(rows):
        shown.add_row(*cells)
    Console().print(shown)
    return 0
