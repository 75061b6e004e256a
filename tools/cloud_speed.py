#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""What a point cloud adds to a plan: whole plans with new points each, with the same points, and without the term.

The points are those of the scene's own camera, repeated with fresh noise up to the wanted number. On a CPU, processor
time is reported beside wall time: with one thread it is what a free core would need.

    python tools/cloud_speed.py --threads 1
    python tools/cloud_speed.py --device cuda:0 --samples 500 4096 32768 --json cloud.json
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import warpmpc

TERM = "cloud_collision"
CLOUDS = 8
"""Different clouds that take turns."""


def clouds(points: np.ndarray, count: int) -> list[np.ndarray]:
    """Clouds of so many points with 3 mm of noise each."""
    rng = np.random.default_rng(0)
    rows = np.resize(np.arange(len(points)), count)
    return [(points[rows] + rng.normal(0.0, 0.003, (count, 3))).astype(np.float32) for _ in range(CLOUDS)]


def measure(controller, state, seen: list[np.ndarray], name: str, plans: int) -> dict[str, dict[str, float]]:
    """Times of plans [ms] of each kind; the kinds take turns, so that none has the quiet moments for itself."""
    kinds = {"new points": [], "same points": [], "no cloud": []}
    weight = float(controller.task[TERM])
    for i in range(plans + 10):
        for kind, times in kinds.items():
            controller.task[TERM] = 0.0 if kind == "no cloud" else weight
            wall, busy = time.perf_counter(), time.process_time()
            if kind == "new points":
                controller.task[name] = seen[i % CLOUDS]
            controller.step(state)
            if i >= 10:
                times.append((1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - busy)))
    rows = {kind: np.array(times) for kind, times in kinds.items()}
    return {
        kind: {
            "wall_p50_ms": float(np.median(t[:, 0])),
            "wall_p99_ms": float(np.quantile(t[:, 0], 0.99)),
            "wall_min_ms": float(t[:, 0].min()),
            "cpu_p50_ms": float(np.median(t[:, 1])),
        }
        for kind, t in rows.items()
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--samples", type=int, nargs="+", default=[500])
    parser.add_argument("--points", type=int, default=50000)
    parser.add_argument("--plans", type=int, default=300)
    parser.add_argument("--threads", type=int, default=0, help="CPU threads, as many as there are if 0")
    parser.add_argument("--lookup", nargs="+", default=["nearest", "linear"])
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    table = Table(box=None, title=f"plans of storm_cloud, {args.points} points, {args.device}")
    for head in ("samples", "lookup", "plan with", "wall p50 [ms]", "p99", "least", "CPU p50"):
        table.add_column(head, justify="right")
    results = []
    for samples in args.samples:
        for lookup in args.lookup:
            changes = [
                f"planner.samples={samples}",
                f"cost.{TERM}.lookup={lookup}",
                f"cloud.seen.capacity={args.points}",
            ]
            threads = [f"engine.threads={args.threads}"] if args.threads else []
            scene = warpmpc.load_scene("storm_cloud", overrides=[*changes, *threads, *args.set])
            controller = warpmpc.Controller(scene, device=args.device)
            plant = warpmpc.Plant(scene, task=controller.task)
            state, name = plant.observe(), scene.cloud[0].name
            found = measure(controller, state, clouds(plant.task[name], args.points), name, args.plans)
            for kind, row in found.items():
                results.append({"samples": samples, "lookup": lookup, "plan": kind, **row})
                figures = (row[k] for k in ("wall_p50_ms", "wall_p99_ms", "wall_min_ms", "cpu_p50_ms"))
                table.add_row(str(samples), lookup, kind, *(f"{x:.3f}" for x in figures))
    Console(width=120).print(table)
    if args.json:
        args.json.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
