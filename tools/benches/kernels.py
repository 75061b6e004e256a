# SPDX-License-Identifier: Apache-2.0
"""Which kernels a plan on a GPU spends its time in, by Warp's activity timing of one plan launched piece by piece.

The captured graph runs the same kernels, back to back.

    python tools/bench.py kernels omni_push_box --set planner.samples=500
"""

from __future__ import annotations

import argparse
from collections import Counter

import warp as wp
from rich.console import Console
from rich.table import Table

import warpmpc


def main(arguments: list[str]) -> None:
    """Time one plan and print its activities, longest first."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--steps", type=int, default=150, help="controls of closed loop before the plan")
    parser.add_argument("--top", type=int, default=25)
    args = parser.parse_args(arguments)
    scene = warpmpc.load_scene(args.scene, overrides=args.set)
    controller = warpmpc.Controller(scene, engine="newton", device=args.device)
    plant = warpmpc.Plant(scene)
    for _ in range(args.steps):
        plant.apply(controller.step(plant.observe()))
    controller.graph.captured, controller.graph.capturable = None, False
    with wp.ScopedTimer("plan", cuda_filter=wp.TIMING_ALL, print=False) as timer:
        controller.step(plant.observe())
    time, count = Counter(), Counter()
    for result in timer.timing_results:
        time[result.name] += result.elapsed
        count[result.name] += 1
    table = Table(box=None, title=f"{sum(count.values())} activities, {sum(time.values()):.2f} ms on the GPU")
    for head in ("activity", "times", "ms", "µs each"):
        table.add_column(head, justify="left" if head == "activity" else "right")
    for name, ms in time.most_common(args.top):
        table.add_row(name, str(count[name]), f"{ms:.3f}", f"{1e3 * ms / count[name]:.1f}")
    Console(width=140).print(table)
