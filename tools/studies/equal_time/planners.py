# SPDX-License-Identifier: Apache-2.0
"""Compare strategies at equal wall-clock: closed-loop cost of tasks × strategies, over seeds.

    python tools/study.py planners --ms 5 --jobs 16 --limit 460
    python tools/study.py planners --tasks pendulum push_t --strategies mppi icem --runs 2

For every task and strategy it first finds the number of samples whose plans take --ms on one thread of this machine,
by timing them. Then every seed is run in closed loop with as many. Whatever a scene says of its horizon, knots, σ and
noise holds for all strategies, but for what a strategy is made of (equal_time/cells.py); ``shipped`` is the scene as it
is, with the number of samples that takes as long as the others, ``samples`` the same without iLQG. An episode goes on
to its end although the goal was reached. Its cost is the mean over its control steps of what the scene's terms cost in
the plant, with their weights.

Cells have the mean over seeds ± Student's t, 95 %, and how many seeds reached the goal with Wilson's interval. What is
done is kept in OUT/planners.jsonl, so that the same command goes on after an interruption or --limit, whose table has
what is done by then.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterable
from concurrent.futures import TimeoutError as Late
from concurrent.futures import as_completed
from dataclasses import asdict, replace
from pathlib import Path

from shared.files import write_json
from shared.machine import machine
from shared.progress import Bar

from studies.equal_time.cells import STRATEGIES, Cell, fit, run
from studies.equal_time.tables import summary, tables
from warpmpc.cli.setup import start_warp
from warpmpc.loop.run.workers import FORMS, FinishedJobs, Workers, check_jobs, open_workers
from warpmpc.scene.origin import code_digest

TASKS = (
    *("pendulum", "cartpole_swingup", "acrobot", "quadrotor", "humanoid_get_up", "quadruped_walk"),
    *("push_t", "omni_push_box", "panda_reach_pose", "cylinder_push"),
)
DAY = 86400.0


def gather(
    work: Callable[[Cell], dict], cells: Iterable[Cell], records: FinishedJobs, workers: Workers, *, until: float
) -> bool:
    """Do what is not recorded yet; False if it was too late for some of it.

    Args:
        work: What is done with a cell.
        cells: The cells, first ones first.
        records: Where it is kept.
        workers: Who does it.
        until: When to stop waiting, by the monotonic clock [s].
    """
    keys = {cell: cell.key(work.__name__) for cell in cells}
    missing = {workers.submit(work, cell): cell for cell in keys if keys[cell] not in records.by_key}
    with Bar(len(missing)) as bar:
        try:
            for future in as_completed(missing, timeout=max(until - time.monotonic(), 0.0)):
                cell = missing[future]
                records.add(keys[cell], {**asdict(cell), **future.result(), "code": code_digest()})
                bar.step(f"{cell.task}, {cell.strategy}, seed {cell.seed}")
        except Late:
            bar.say(f"stopped by --limit: {sum(not future.done() for future in missing)} are left")
            return False
    return True


def episodes(tasks: list[str], strategies: list[str], args: argparse.Namespace, records: FinishedJobs) -> list[Cell]:
    """Episodes of every cell whose number of samples is known, seed by seed."""
    cells = []
    for seed in range(args.seed, args.seed + args.runs):
        for strategy in strategies:
            for task in tasks:
                cell = Cell(task=task, strategy=strategy, ms=args.ms)
                found = records.by_key.get(cell.key("fit"))
                if found:
                    seconds = min(args.seconds, cell.scene.timing.timeout)
                    cells.append(replace(cell, samples=found["samples"], seed=seed, seconds=seconds))
    return cells


def main(arguments: list[str]) -> int:
    """Fit samples, run episodes, print the tables; returns the exit code: 1 where --limit left some out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), metavar="SCENE")
    parser.add_argument("--strategies", nargs="+", default=list(STRATEGIES), choices=STRATEGIES, metavar="NAME")
    parser.add_argument("--ms", type=float, default=5.0, help="wall time of a plan (default 5)")
    parser.add_argument("--seconds", type=float, default=12.0, help="longest episode (default 12)")
    parser.add_argument("--runs", type=int, default=10, help="seeds (default 10)")
    parser.add_argument("--seed", type=int, default=0, help="first seed (default 0)")
    parser.add_argument("--jobs", default="1", metavar="WHERE", help=f"{FORMS} (default 1)")
    parser.add_argument("--limit", type=float, default=DAY, help="stop after so many seconds")
    parser.add_argument("--out", type=Path, default=Path("build/results"), help="folder of the results")
    args = parser.parse_args(arguments)
    until = time.monotonic() + args.limit
    check_jobs(args.jobs)
    records = FinishedJobs(args.out / "planners.jsonl")
    workers, _ = open_workers(args.jobs, device="cpu", prepare=start_warp)
    measured = [Cell(task=t, strategy=s, ms=args.ms) for s in args.strategies for t in args.tasks]
    with workers:
        whole = gather(fit, measured, records, workers, until=until)
        cells = episodes(args.tasks, args.strategies, args, records)
        whole = gather(run, cells, records, workers, until=until) and whole
    rows = summary(cells, records)
    text = tables(rows, ms=args.ms, seconds=args.seconds)
    about = {"machine": machine(), "ms": args.ms, "seconds": args.seconds, "strategies": STRATEGIES}
    write_json(args.out / "planners.json", {**about, "rows": rows})
    print(text, end="")
    return 0 if whole else 1
