#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Time whole plans of the engine ``kinematic``, from observation to command, over numbers of samples.

    python tools/bench_kinematic.py                                  # storm_reach on the CPU
    python tools/bench_kinematic.py storm_reach --device cuda:0 --samples 500 4096 32768 --json out.json
    python tools/bench_kinematic.py my_scene.toml --terms my_terms.py

Every plan starts from another state near the scene's start, so that nothing is measured twice. The floor beside it is
the launch that rolls out and judges alone, replayed in the same process.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import warp as wp
from rich.console import Console
from rich.table import Table

import warpmpc
from warpmpc.cli.terms import TermsError, load_terms

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from warpmpc import ArrayCost, CostTerm


def percentiles(run: Callable[[int], None], count: int) -> tuple[float, float]:
    """Median and 99th percentile of the wall time of ``run(i)`` [ms]."""
    times = []
    for i in range(count):
        start = time.perf_counter()
        run(i)
        times.append(1e3 * (time.perf_counter() - start))
    return float(np.median(times)), float(np.percentile(times, 99))


def bench(
    name: str,
    samples: int,
    device: str,
    *,
    plans: int,
    overrides: Sequence[str] = (),
    terms: Sequence[CostTerm | ArrayCost] = (),
) -> dict:
    """Time the plans of one scene.

    Returns:
        Medians and 99th percentiles [ms].
    """
    scene = warpmpc.load_scene(name, overrides=[*overrides, f"planner.samples={samples}"])
    mpc = warpmpc.Controller(scene, engine="kinematic", device=device, seed=0, terms=terms)
    rng, layout = np.random.default_rng(0), mpc.layout
    q = np.tile(layout.joint_q, (64, 1))
    driven = layout.dof_coord[layout.actuator_dof]
    q[:, driven] += rng.normal(0.0, 0.05, (64, len(driven)))
    qd = np.zeros((64, layout.nv), dtype=np.float32)
    qd[:, layout.actuator_dof] = rng.normal(0.0, 0.1, (64, len(driven)))
    states = [warpmpc.State(*row) for row in zip(q, qd, strict=True)]
    for i in range(20):
        mpc.step(states[i])
    plan = percentiles(lambda i: mpc.step(states[i % 64]), plans)
    replay = replayed(mpc)
    launch = percentiles(lambda _: replay(), plans)
    result = {"scene": name, "samples": samples, "device": device, "threads": mpc.engine.threads}
    result |= {"plan_p50_ms": plan[0], "plan_p99_ms": plan[1], "launch_p50_ms": launch[0]}
    result["recorded"] = mpc.engine.records
    mpc.engine.close()
    return result


def replayed(mpc: warpmpc.Controller) -> Callable[[], None]:
    """The launch that rolls out and judges, alone; with all its threads on the CPU, as a graph on a GPU."""
    engine, proposal = mpc.engine, Held(mpc.planner.strategy)
    if wp.get_device(mpc.device).is_cpu:
        for _ in range(3):
            engine.evaluate(proposal)
        return lambda: engine.evaluate(proposal)
    with wp.ScopedCapture(device=mpc.device) as capture:
        engine.evaluate(proposal)

    def run() -> None:
        wp.capture_launch(capture.graph)
        wp.synchronize_device(mpc.device)

    return run


class Held:
    """Knots as they are: nothing is sampled.

    Args:
        strategy: Whose knots.
    """

    def __init__(self, strategy: object):
        self.knots, self.offset, self.samples = strategy.knots, strategy.offset, strategy.knots.shape[1]

    def sample(self, first: int, count: int) -> None:
        """Leave the knots as they are."""


def main() -> None:
    """Time scenes and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", nargs="*", default=["storm_reach"])
    parser.add_argument("--samples", type=int, nargs="+", default=[500])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--plans", type=int, default=1000)
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--terms", type=Path, help="Python file with cost terms of your own")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    try:
        terms = load_terms([options.terms]) if options.terms else []
    except TermsError as error:
        parser.error(str(error))
    results = []
    for name in options.scene:
        for samples in options.samples:
            found = bench(name, samples, options.device, plans=options.plans, overrides=options.overrides, terms=terms)
            results.append(found)
    table = Table("scene", "samples", "device", "threads", "plan p50 [ms]", "p99", "launch alone", "recorded")
    for r in results:
        times = [f"{r[key]:.3f}" for key in ("plan_p50_ms", "plan_p99_ms", "launch_p50_ms")]
        table.add_row(r["scene"], str(r["samples"]), r["device"], str(r["threads"]), *times, str(r["recorded"]))
    Console(width=130).print(table)
    if options.json:
        machine = {"cpu": platform.processor(), "cores": len(os.sched_getaffinity(0))}
        if options.device != "cpu":
            machine["gpu"] = wp.get_device(options.device).name
        options.json.write_text(json.dumps({"machine": machine, "results": results}, indent=1))


if __name__ == "__main__":
    main()
