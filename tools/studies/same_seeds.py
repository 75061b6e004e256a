# SPDX-License-Identifier: Apache-2.0
"""Run scenes in closed loop with two engines on the same seeds, and compare success and time seed by seed.

    python tools/study.py same_seeds push_t point_reach --runs 16 --jobs 2
    python tools/study.py same_seeds --runs 16 --jobs 16                 # every shipped scene that both can do
    python tools/study.py same_seeds omni_push_box:A --engines fused newton --device cuda:0

A seed draws the same task, the same plant and the same noise with either engine. Differences are the first engine's
figure minus the second's, with 95 % intervals: of success rates as Bonett and Price (2012), of times to the goal by
Student's t over the seeds that both reached. Finished runs are kept in OUT/same_seeds.jsonl and never repeated while
scene, overrides, seed, engine and device are the same; an interrupted command goes on.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from shared.files import write_json
from shared.intervals import mean_difference, rate_difference
from shared.machine import machine
from shared.progress import Bar

import warpmpc
from studies.experiments.runs import Run, make_runs, plan_runs
from studies.experiments.tables import Cell
from warpmpc.origin import code_digest
from warpmpc.run.records import Records
from warpmpc.run.workers import FORMS
from warpmpc.scene.schema import EngineName


def compared(first: list[dict], second: list[dict]) -> dict:
    """Success and time of two engines over the same seeds, and their differences.

    Args:
        first: Results of one engine, seed by seed, as :meth:`warpmpc.EpisodeResult.to_json` has them.
        second: Those of the other, in the same order.
    """
    reached = np.array([[bool(r["success"]) for r in side] for side in (first, second)])
    both = reached.all(axis=0)
    times = np.array(
        [[r["time_to_goal_s"] for r, use in zip(side, both, strict=True) if use] for side in (first, second)]
    )
    return {
        "seeds": len(first),
        "success": reached.sum(axis=1).tolist(),
        "success_difference": rate_difference(reached[0], reached[1]),
        "time_s": [_mean([r["time_to_goal_s"] for r in side if r["success"]]) for side in (first, second)],
        "time_difference_s": mean_difference(times[0] - times[1]),
        "plan_ms": [float(np.median([r["plan_ms"]["p50"] for r in side])) for side in (first, second)],
    }


def _mean(values: list[float]) -> float | None:
    return float(np.mean(values)) if values else None


def show(rows: list[dict], engines: list[str]) -> None:
    """One table of all scenes."""
    a, b = engines
    heads = (
        "scene",
        "seeds",
        f"reached: {a}",
        b,
        "difference in %",
        f"time in s: {a}",
        b,
        "difference in s",
        "plan in ms",
    )
    table = Table(*heads, box=None)
    for r in rows:
        lead, low, high = (100 * x for x in r["success_difference"])
        times = [f"{t:.2f}" if t is not None else "-" for t in r["time_s"]]
        gap = r["time_difference_s"]
        table.add_row(
            r["scene"],
            str(r["seeds"]),
            *map(str, r["success"]),
            f"{lead:+.0f} ({low:+.0f} to {high:+.0f})",
            *times,
            "-" if gap is None else f"{gap[0]:+.2f} ({gap[1]:+.2f} to {gap[2]:+.2f})",
            " / ".join(f"{t:.1f}" for t in r["plan_ms"]),
        )
    Console(width=None if sys.stdout.isatty() else 170).print(table)


def main(arguments: list[str]) -> int:
    """Make the runs that are missing, compare, print; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "scenes", nargs="*", help="scenes, with or without variants; shipped ones with physics by default"
    )
    parser.add_argument("--engines", nargs=2, default=["fused", "mujoco"], metavar="ENGINE")
    parser.add_argument("--device", default="auto", help="device of engines that run on it; the others take the CPU")
    parser.add_argument("--runs", type=int, default=16, help="seeds per scene (default 16)")
    parser.add_argument("--seed", type=int, default=0, help="first seed (default 0)")
    parser.add_argument(
        "--jobs", default="1", metavar="WHERE", help=f"{FORMS} (default 1); on one thread each if several"
    )
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--out", type=Path, default=Path("build/results"), help="folder of the results")
    args = parser.parse_args(arguments)
    seeds = range(args.seed, args.seed + args.runs)
    plans: dict[str, dict[str, list[Run]]] = {}
    devices = _devices(args.engines, args.device)
    for name in args.scenes or _with_physics():
        cell = Cell(name=name, title=name, scenes=(name,))
        plans[name] = {
            engine: plan_runs("same_seeds", [cell], seeds=seeds, overrides=args.overrides, engine=engine, device=device)
            for engine, device in zip(args.engines, devices, strict=True)
        }
    records, rows = Records(args.out / "same_seeds.jsonl"), []
    here = machine()
    circumstances = {"code": code_digest(), "cpu": here["cpu"], "cores": here["cores"]}
    every = [run for by_engine in plans.values() for runs in by_engine.values() for run in runs]
    with Bar(sum(run.key not in records.by_key for run in every)) as bar:
        for name, by_engine in plans.items():
            try:
                for runs, device in zip(by_engine.values(), devices, strict=True):
                    make_runs(
                        runs,
                        records,
                        jobs=args.jobs,
                        device=device,
                        circumstances=circumstances,
                        on_done=lambda run, _: bar.step(f"{run.cell} seed {run.job.seed}, {run.job.engine}"),
                    )
            except ValueError as error:  # an engine that cannot do this scene
                bar.say(f"{name}: left out: {str(error).splitlines()[0]}")
                continue
            first, second = ([records.by_key[run.key]["result"] for run in runs] for runs in by_engine.values())
            rows.append({"scene": name, **compared(first, second)})
            report = {"machine": here, "engines": args.engines, "overrides": args.overrides, "rows": rows}
            write_json(args.out / "same_seeds.json", report)
    show(rows, args.engines)
    return 0


def _with_physics() -> list[str]:
    """The shipped scenes whose rollouts are physics."""
    return [n for n in warpmpc.shipped_scenes() if warpmpc.load_scene(n).engine.name is not EngineName.KINEMATIC]


def _devices(engines: list[str], device: str) -> list[str]:
    """Device of each engine: where it cannot run on the one that was asked for, its own."""
    from warpmpc.engine.registry import ENGINES

    on_cpu = device in ("auto", "cpu")
    return [device if (ENGINES[name].cpu if on_cpu else ENGINES[name].cuda) else "auto" for name in engines]
