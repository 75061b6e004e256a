# SPDX-License-Identifier: Apache-2.0
"""Run shipped scenes without some of their planner's keys: which of them do a scene any good?

    python tools/study.py keys --jobs 16                             # every group left out alone, tuning seeds 0 to 2
    python tools/study.py keys --jobs 16 --seeds 3:8 --together      # what did no good alone, left out together

A scene is run as shipped, without any of its planner's keys (``all``), and without one group of them at a time. A group
does no good when the runs without it reach the goal as often, in at most a tenth more time, with plans that take at
most a tenth longer or a tenth of a control. With ``--together`` every such group is left out, and all of them but one.
Finished episodes are kept in OUT/keys.jsonl; the same command goes on after an interruption.
"""

from __future__ import annotations

import argparse
import time
from concurrent.futures import TimeoutError as Late
from concurrent.futures import as_completed
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from shared.progress import Bar

import warpmpc
from warpmpc.cli.setup import start_warp
from warpmpc.run.episode import run_episode
from warpmpc.run.records import Records
from warpmpc.run.workers import FORMS, check_jobs, open_workers
from warpmpc.scene.schema import Scene
from warpmpc.scene.schema_planner import Planner

GROUPS = {
    "method": ("method",),
    "samples": ("samples",),
    "iterations": ("iterations",),
    "rounds": ("samples", "iterations"),
    "lookahead": ("lookahead",),
    "dt": ("dt",),
    "knots": ("knots", "spline"),
    "weights": ("discount", "terminal"),
    "keep_best": ("keep_best",),
    "sigma": ("noise.sigma",),
    "spread": ("noise.spread", "noise.constant", "noise.redraw"),
    "temperature": ("temperature",),
}
"""Keys that are left out together."""
TASKS = (
    *("acrobot", "box_carry", "cartpole_swingup", "cylinder_push", "diff_push_box", "go2_jump", "go2_walk"),
    *("humanoid_get_up", "humanoid_stand", "mobile_pick", "omni_push_box", "omni_push_sphere", "panda_push"),
    *("panda_push_objects", "panda_reach", "panda_reach_pose", "pendulum", "point_reach", "push_t", "quadrotor"),
    *("quadruped_terrain", "quadruped_walk", "walker", "g1_walk"),
)
"""Scenes whose planner is our own; those of STORM's tasks have the paper's."""
LONGEST = 30.0
"""Longest episode [s]: what has not arrived by then counts as failed."""
MORE = 1.1
"""Factor by which runs and plans may take longer."""
CHEAP = 0.1
"""Share of a control [s] below which a longer plan does no harm."""


def short(scene: Scene) -> dict:
    """Planner's keys of a scene, with ``lookahead`` for a ``horizon`` and without what the defaults say too."""
    own, defaults = scene.planner.model_dump(exclude_unset=True), Planner().model_dump()
    if "horizon" in own:
        (dt,) = own["dt"]
        own = {**own, "lookahead": round(own.pop("horizon") * dt, 6)}
    noise = own.pop("noise", {})
    out = {key: value for key, value in own.items() if value != defaults[key]}
    return {**out, "noise": {key: value for key, value in noise.items() if value != defaults["noise"][key]}}


def without(planner: dict, groups: list[str]) -> dict:
    """A planner's keys without those of groups."""
    out = {**planner, "noise": dict(planner["noise"])}
    for key in (key for group in groups for key in GROUPS[group]):
        table, _, name = key.rpartition(".")
        (out[table] if table else out).pop(name, None)
    return out


def scene_without(task: str, groups: list[str]) -> Scene:
    """A scene without groups of its planner's keys, on one thread."""
    scene = warpmpc.load_scene(task, overrides=["engine.threads=1"])
    planner = {} if groups == ["all"] else without(short(scene), groups)
    timing = scene.timing.model_copy(update={"timeout": min(scene.timing.timeout, LONGEST)})
    data = {**scene.model_dump(exclude_unset=True), "planner": planner, "path": scene.path}
    return Scene.model_validate(data).model_copy(update={"timing": timing})


def play(task: str, groups: list[str], seed: int) -> dict:
    """One episode: what became of it."""
    scene = scene_without(task, groups)
    result = run_episode(scene, seed=seed, engine="fused", device="cpu")
    row = {"task": task, "without": groups, "seed": seed, "passed": result.passed, "reason": result.reason}
    row["control_ms"] = 1e3 * scene.timing.control_dt
    return {**row, "seconds": result.sim_time, "cost": result.mean_cost, "plan_ms": result.plan_ms["p50"]}


def numbers(rows: list[dict]) -> tuple[int, int, float, float]:
    """Episodes, how many of them passed, their mean time or cost, their median plan time."""
    passed = [row for row in rows if row["passed"]]
    what = [row["seconds"] if row["cost"] is None else row["cost"] for row in passed]
    taken = float(np.mean(what)) if what else float("nan")
    return len(rows), len(passed), taken, float(np.median([row["plan_ms"] for row in rows]))


def no_good(rows: list[dict], shipped: list[dict]) -> bool:
    """Return whether runs without a group are as good as those of the scene as shipped, over the seeds of both."""
    seeds = {row["seed"] for row in rows} & {row["seed"] for row in shipped}
    (n, passed, taken, plan), (_, before, took, planned) = (
        numbers([row for row in part if row["seed"] in seeds]) for part in (rows, shipped)
    )
    quick = plan <= max(MORE * planned, CHEAP * rows[0]["control_ms"])
    return n > 0 and passed >= before and not taken > MORE * took and quick


def together(task: str, rows: list[dict]) -> list[list[str]]:
    """The groups that did a scene no good alone: all of them, and all but each one."""
    alone: dict[str, list[dict]] = {}
    for row in rows:
        if row["task"] == task and len(row["without"]) == 1:
            alone.setdefault(row["without"][0], []).append(row)
    shipped = [row for row in rows if row["task"] == task and not row["without"]]
    found = [group for group, part in alone.items() if group != "all" and shipped and no_good(part, shipped)]
    fewer = [[g for g in found if g != group] for group in found] if len(found) > 2 else []
    return [groups for groups in (found, *fewer) if len(groups) > 1]


def main(arguments: list[str]) -> int:
    """Run the episodes and print the table; returns the exit code: 1 where --limit left some out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), metavar="SCENE")
    parser.add_argument("--together", action="store_true", help="leave out together what did no good alone")
    parser.add_argument("--seeds", default="0:3", metavar="FIRST:LAST", help="tuning seeds (default 0:3)")
    parser.add_argument("--jobs", default="1", metavar="WHERE", help=f"{FORMS} (default 1)")
    parser.add_argument("--limit", type=float, default=86400.0, help="stop after so many seconds")
    parser.add_argument("--out", type=Path, default=Path("build/results"), help="folder of the results")
    args = parser.parse_args(arguments)
    check_jobs(args.jobs)
    until = time.monotonic() + args.limit
    records = Records(args.out / "keys.jsonl")
    first, last = map(int, args.seeds.split(":"))
    cells, before = {}, list(records.by_key.values())
    for seed in range(first, last):
        for task in args.tasks:
            planner = short(warpmpc.load_scene(task))
            alone = {str(without(planner, [g])): [g] for g in GROUPS if without(planner, [g]) != planner}
            less = together(task, before) if args.together else [["all"], *alone.values()]
            for groups in [[], *less]:
                cells[f"{task} {'+'.join(groups)} {seed}"] = (task, groups, seed)
    workers, _ = open_workers(args.jobs, device="cpu", prepare=start_warp)
    missing = [key for key in cells if key not in records.by_key]
    with workers, Bar(len(missing)) as bar:
        jobs = {workers.submit(play, *cells[key]): key for key in missing}
        try:
            for future in as_completed(jobs, timeout=max(until - time.monotonic(), 0.0)):
                records.add(jobs[future], future.result())
                bar.step(jobs[future])
        except Late:
            bar.say("stopped by --limit")
            for future in jobs:
                future.cancel()
    shown = Table("task", "without", "passed", "time [s] or cost", "plan [ms]", "no good")
    rows = [records.by_key[key] for key in cells if key in records.by_key]
    for task in args.tasks:
        own = [row for row in rows if row["task"] == task]
        for groups in dict.fromkeys(tuple(row["without"]) for row in own):
            part = [row for row in own if tuple(row["without"]) == groups]
            n, passed, taken, plan = numbers(part)
            mark = "yes" if groups and no_good(part, [row for row in own if not row["without"]]) else ""
            shown.add_row(task, ", ".join(groups), f"{passed} of {n}", f"{taken:.3g}", f"{plan:.3g}", mark)
    Console(width=110).print(shown)
    return 0 if len(rows) == len(cells) else 1
