# SPDX-License-Identifier: Apache-2.0
"""A slower clock buys plans: a quadruped on rough ground, planned for in real time at several speeds of the clock.

    python tools/study.py slow_down --runs 5 --speeds 1 0.3 0.1 --jobs 5     # on an idle machine
    python tools/study.py slow_down --draw docs/slow_down.png                # of earlier runs

The planner is another process and the plant does not wait for it, as in MuJoCo MPC (Howell et al. 2022, Alg. 1).
Plans are ``one`` for a control, which a slower clock does not change, or as many as ``fit``; both run at every speed.
A run takes two cores. Finished runs are kept in OUT/slow_down.jsonl; the same command goes on after an interruption.
"""

from __future__ import annotations

import argparse
import json
from itertools import product
from pathlib import Path

import numpy as np
from shared.files import put_rows
from shared.intervals import rate

import warpmpc
from warpmpc.cli.setup import start_warp
from warpmpc.loop.run.real_time import run_real_time
from warpmpc.loop.run.workers import FORMS, FinishedJobs, open_workers
from warpmpc.scene.origin import code_digest

SCENE = "quadruped_terrain:paper"
OVERRIDES = ("engine.threads=1", "timing.control_dt=0.02", "plant.substeps=10")
"""Controls as long as the scene's own: with ``one`` there are 50 plans in a simulated second."""
KINDS = {"one": "one plan a control", "fit": "as many plans as fit"}
COLUMNS = ("plans", "speed of the clock", "reached", "time [s]", "plans in a simulated second", "plan [ms]")


def play(kind: str, speed: float, seed: int, timeout: float) -> dict:
    """One run in real time, plain data."""
    changes = (*OVERRIDES, f'agent.plans="{kind}"', f"timing.timeout={timeout}")
    result = run_real_time(
        warpmpc.load_scene(SCENE, overrides=changes), seed=seed, engine="fused", device="cpu", speed=speed
    )
    return {"kind": kind, "speed": speed, "seed": seed, **result.to_json()}


def groups(rows: list[dict]) -> dict[tuple[str, float], list[dict]]:
    """Runs by kind and speed, fast ones first."""
    pairs = product(KINDS, sorted({row["speed"] for row in rows}, reverse=True))
    found = {pair: [row for row in rows if (row["kind"], row["speed"]) == pair] for pair in pairs}
    return {pair: of for pair, of in found.items() if of}


def figures(rows: list[dict]) -> list[list[str]]:
    """Rows of ``docs/data``: times are of the runs that reached the last waypoint, plans medians over all."""
    lines = []
    for (kind, speed), of in groups(rows).items():
        times = [row["sim_time_s"] for row in of if row["success"]]
        spread = f"{np.mean(times):.3g} ({min(times):.3g} to {max(times):.3g})" if times else "-"
        plans = np.median([row["plans"] / row["sim_time_s"] for row in of])
        ms = np.median([row["plan_ms"]["p50"] for row in of])
        lines.append([KINDS[kind], f"{speed:g}", f"{len(times)} of {len(of)}", spread, f"{plans:.0f}", f"{ms:.3g}"])
    return lines


def draw(rows: list[dict], path: Path) -> None:
    """Success over speed, with bars of 95 %."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.0, 3.4), layout="constrained")
    axes, found = figure.subplots(), groups(rows)
    for shift, (kind, label) in zip((1.02, 0.98), KINDS.items(), strict=True):  # bars side by side
        speeds = [speed for known, speed in found if known == kind]
        rates = [rate(sum(row["success"] for row in of), len(of)) for pair, of in found.items() if pair[0] == kind]
        value, low, high = (100.0 * np.array([getattr(r, name) for r in rates]) for name in ("value", "low", "high"))
        axes.errorbar(shift * np.array(speeds), value, [value - low, high - value], label=label, marker="o", capsize=3)
    axes.set(xscale="log", xlabel="speed of the clock", ylabel="at the last waypoint [%]", ylim=(-3, 103))
    axes.set_xticks(speeds, [f"{speed:g}" for speed in speeds])
    axes.invert_xaxis()  # slower to the right
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=150)


def main(arguments: list[str]) -> None:
    """Make the runs that are missing, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--speeds", nargs="+", type=float, default=[1.0, 0.3, 0.1], metavar="SPEED")
    parser.add_argument("--runs", type=int, default=5, help="seeds of a speed (default 5)")
    parser.add_argument("--seed", type=int, default=0, help="first seed (default 0)")
    parser.add_argument("--timeout", type=float, default=20.0, help="simulated time of a run at most [s] (default 20)")
    parser.add_argument("--jobs", default="1", metavar="WHERE", help=f"{FORMS}, two cores each (default 1)")
    parser.add_argument("--out", type=Path, default=Path("build/results"), help="folder of the results")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the table's figures, as docs/data has them")
    parser.add_argument("--draw", type=Path, metavar="PNG", help="draw earlier runs in OUT, and run nothing")
    args = parser.parse_args(arguments)
    records = FinishedJobs(args.out / "slow_down.jsonl")
    if args.draw:
        draw(list(records.by_key.values()), args.draw)
        return
    seeds = range(args.seed, args.seed + args.runs)
    runs = [(kind, speed, seed, args.timeout) for speed in sorted(args.speeds) for seed in seeds for kind in KINDS]
    keys = {run: json.dumps([*run, code_digest()]) for run in runs}
    workers, _ = open_workers(args.jobs, device="cpu", prepare=start_warp)
    with workers:
        jobs = {run: workers.submit(play, *run) for run in runs if keys[run] not in records.by_key}
        for run, job in jobs.items():
            records.add(keys[run], job.result())
            print(json.dumps(records.by_key[keys[run]]), flush=True)
    rows = figures([records.by_key[key] for key in keys.values()])
    print(*(" | ".join(row) for row in (COLUMNS, *rows)), sep="\n")
    if args.json:
        put_rows(args.json, COLUMNS, rows, study="slow_down", arguments=arguments)
