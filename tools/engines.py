#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
r"""Time plans on every engine against the same physics alone, over sample counts and solver options.

States come from a closed-loop run of the scene, so that contacts are in play. Every plan is followed by the bare
physics with the same worlds, states and controls: for ``newton`` the same solver steps in a CUDA graph of their own,
for ``mujoco`` a bare call of ``mujoco.rollout``; ``fused`` has none. Ratios are taken pair by pair. ``fused`` runs on
the CPU and on the GPU, where there is one. Rows are written as they come; tools/plot_engines.py draws several files.

    python tools/engines.py omni_push_box --samples sweep --limit 5 --json engines.json --plot engines.png
    python tools/engines.py omni_push_box --engines fused@cuda:0,newton --samples 128,500,2048 --horizon 8
    python tools/engines.py omni_push_box --engines newton --samples 500 \\
        --case default: --case 'euler:engine.options.integrator="euler"'
"""

from __future__ import annotations

import argparse
import json
import os
import time
from importlib.metadata import version
from pathlib import Path

import mujoco
import numpy as np
import warp as wp
from bench import machine
from plan_times import bare_physics, batched, time_plans, visited_states
from rich.console import Console
from rich.table import Table

import warpmpc
from warpmpc.cli.setup import start_warp
from warpmpc.engine.registry import ENGINES, physics_steps
from warpmpc.model.compiled import compile_scene
from warpmpc.planner.step import STAGES

STATES = 12
"""States from the closed-loop run that the plans are made from, in turn."""
SWEEP = "16,32,64,128,256,512,1024,2048,4096,8192"
"""Sample counts of ``--samples sweep``."""


def stage_times(controller: warpmpc.Controller, plans: int = 30) -> dict[str, float]:
    """Median time of each stage [ms]: on CUDA each captured and launched alone, else as the plans measured it."""
    device = wp.get_device(controller.device)
    if not device.is_cuda:
        return dict(controller.info.stages_ms)
    times = dict.fromkeys(STAGES, 0.0)
    for stage, run in controller.planner.sequence():
        with wp.ScopedCapture(device=device) as capture:
            run()
        samples = []
        for _ in range(plans):
            wp.synchronize_device(device)
            start = time.perf_counter()
            wp.capture_launch(capture.graph)
            wp.synchronize_device(device)
            samples.append(time.perf_counter() - start)
        times[stage] += 1e3 * float(np.median(samples))
    return times


def activities(controller: warpmpc.Controller, state: warpmpc.State) -> dict[str, int]:
    """What one plan makes the GPU do when launched piece by piece: kernels, copies, fills, by Warp's own timing."""
    if not wp.get_device(controller.device).is_cuda:
        return {}
    graph = controller.graph.captured
    controller.graph.captured, controller.graph.capturable = None, False
    before = wp.get_mempool_used_mem_current(controller.device)
    with wp.ScopedTimer("plan", cuda_filter=wp.TIMING_ALL, print=False) as timer:
        controller.step(state)
    allocated = wp.get_mempool_used_mem_current(controller.device) - before
    controller.graph.captured, controller.graph.capturable = graph, True
    kinds = [r.name.split()[0] if r.name.startswith(("memcpy", "memset")) else "kernel" for r in timer.timing_results]
    names = [r.name for r in timer.timing_results if r.name.startswith(("memcpy", "memset"))]
    counts = {kind: kinds.count(kind) for kind in sorted(set(kinds))}
    return {**counts, **{n: names.count(n) for n in sorted(set(names))}, "bytes still allocated": int(allocated)}


def fidelity(controller: warpmpc.Controller, compiled, states: list[warpmpc.State]) -> dict[str, float] | None:
    """How far bodies end up [mm] from where MuJoCo's C engine takes them, same controls and worlds, as percentiles.

    Of every world the body that is off the most counts. The reference takes as many steps and solves each to the end.
    """
    if controller.engine.name != "newton":
        return None
    exact = controller.scene.engine.model_copy(update={"iterations": 100, "tolerance": 1e-8})
    scene = controller.scene.model_copy(update={"engine": exact})
    reference = warpmpc.Controller(scene, engine="mujoco", seed=controller.seed, compiled=compiled)
    errors = []
    for state in states[:: max(1, len(states) // 4)]:
        controller.step(state)
        control = wp.clone(controller.engine.control, device="cpu")
        reference.step(state)
        exactly = reference.engine.simulator
        exactly.clone(reference.planner.state)
        exactly.rollout(control)
        ours, theirs = (c.engine.simulator.trajectory.body_q.numpy()[-1, :, :, :3] for c in (controller, reference))
        errors.append(1e3 * np.linalg.norm(ours - theirs, axis=-1).max(axis=-1))
    reference.engine.close()
    errors = np.nan_to_num(np.concatenate(errors), nan=np.inf)
    return {f"p{p}": float(np.percentile(errors, p)) for p in (50, 90, 99)}


def places(engines: str, device: str) -> list[tuple[str, str]]:
    """Engines and the devices they run on here, from ``NAME`` and ``NAME@DEVICE`` separated by commas."""
    out = []
    for text in engines.split(","):
        name, _, where = text.partition("@")
        if where:
            out.append((name, where))
            continue
        on_gpu = ENGINES[name].cuda and device != "cpu"
        out += [(name, "cpu")] if ENGINES[name].cpu and not (name == "newton" and on_gpu) else []
        out += [(name, device)] if on_gpu else []
    return out


def cpu_name() -> str:
    """What the processor is called."""
    return machine()["cpu"]


def measure(source: str, case: str, overrides: list[str], engine: str, device: str, args, states) -> dict:
    """Time one engine on one scene; times in milliseconds."""
    scene = warpmpc.load_scene(source, overrides=overrides)
    compiled = compile_scene(scene)
    cuda = wp.get_device(device).is_cuda
    free = wp.get_device(device).free_memory if cuda else 0
    began = time.perf_counter()
    controller = warpmpc.Controller(scene, engine=engine, device=device, envs=args.envs, compiled=compiled)
    states = batched(states, args.envs)
    controller.step(states[0])
    controller.step(states[0])
    ready = time.perf_counter() - began
    bare = bare_physics(controller)
    plan, floor = time_plans(controller, states, plans=args.plans, seconds=args.limit, bare=bare)
    shape = controller.shape
    count = physics_steps(engine, scene, compiled, controller.planner.grid).count
    steps = shape.worlds * sum(count)
    first = controller.info if args.envs == 1 else controller.info[0]
    row = {
        "scene": source,
        "case": case,
        "engine": engine,
        "solver": str(scene.engine.solver) if engine == "newton" else None,
        "device": wp.get_device(controller.device).name if cuda else cpu_name(),
        "cores": None if cuda else scene.engine.threads or len(os.sched_getaffinity(0)),
        "envs": args.envs,
        "samples": shape.rollouts,
        "horizon": shape.horizon,
        "substeps": count[0],
        "overrides": overrides,
        "plan_ms": {name: float(np.percentile(plan, p)) for name, p in (("p50", 50), ("p99", 99))},
        "floor_ms": float(np.median(floor)) if floor else None,
        "ratio": float(np.median(np.array(plan) / floor)) if floor else None,
        "plans": len(plan),
        "plans_per_s": 1e3 / float(np.median(plan)),
        "world_steps_per_s": 1e3 * steps / float(np.median(plan)),
        "stages_ms": stage_times(controller),
        "memory_MiB": (free - wp.get_device(device).free_memory) / 2**20 if cuda else None,
        "start_s": ready,
        "diverged": first.diverged_worlds,
        "overflow": int(controller.engine.overflow.numpy().max()),
    }
    if args.envs == 1:
        row["activities"] = activities(controller, states[-1])
        if args.fidelity:
            row["error_mm"] = fidelity(controller, compiled, states)
    controller.engine.close()
    return row


def print_rows(rows: list[dict]) -> None:
    """One table of everything measured."""
    table = Table(box=None)
    for head in (
        "scene",
        "case",
        "engine",
        "E",
        "K",
        "T·n",
        "p50 ms",
        "p99",
        "floor",
        "ratio",
        "M steps/s",
        "off by mm p50/90/99",
        "MiB",
    ):
        table.add_column(head, justify="left" if head in ("scene", "case", "engine") else "right")
    for r in rows:
        table.add_row(
            r["scene"],
            r["case"],
            f"{r['engine']}/{r['solver']}" if r["engine"] == "newton" else r["engine"],
            str(r["envs"]),
            str(r["samples"]),
            f"{r['horizon']}·{r['substeps']}",
            f"{r['plan_ms']['p50']:.3f}",
            f"{r['plan_ms']['p99']:.3f}",
            "-" if r["floor_ms"] is None else f"{r['floor_ms']:.3f}",
            "-" if r["ratio"] is None else f"{r['ratio']:.3f}",
            f"{1e-6 * r['world_steps_per_s']:.2f}",
            "-" if r.get("error_mm") is None else " / ".join(f"{v:.1f}" for v in r["error_mm"].values()),
            "-" if r["memory_MiB"] is None else f"{r['memory_MiB']:.0f}",
        )
    Console(width=160).print(table)


def main() -> None:
    """Measure and report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--engines", default="fused,mujoco,newton", help="NAME or NAME@DEVICE, separated by commas")
    parser.add_argument("--device", default="auto", help="the GPU; auto: the preferred one, if there is any")
    parser.add_argument("--samples", default="", help="sample counts, or sweep: 16 to 8192; the scene's own by default")
    parser.add_argument("--horizon", type=int)
    parser.add_argument("--envs", type=int, default=1)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--case", action="append", default=[], metavar="NAME:KEY=VALUE;...")
    parser.add_argument("--plans", type=int, default=100)
    parser.add_argument("--limit", type=float, default=20.0, help="longest time for the plans of a row [s]")
    parser.add_argument("--seconds", type=float, default=8.0, help="length of the run that states are taken from")
    parser.add_argument("--fidelity", action="store_true", help="compare the newton engine's rollouts with MuJoCo's")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--plot", type=Path)
    args = parser.parse_args()

    start_warp()
    device = str(wp.get_preferred_device()) if args.device == "auto" else args.device
    common = [*args.set, *([f"planner.horizon={args.horizon}"] if args.horizon else [])]
    rows = []
    for source in args.scenes:
        states = visited_states(source, args.seconds, count=STATES)
        for samples in (SWEEP if args.samples == "sweep" else args.samples).split(","):
            for case in args.case or [":"]:
                name, _, keys = case.partition(":")
                overrides = [
                    *common,
                    *([f"planner.samples={samples}"] if samples else []),
                    *filter(None, keys.split(";")),
                ]
                for engine, where in places(args.engines, device):
                    try:
                        rows.append(measure(source, name, overrides, engine, where, args, states))
                    except Exception as error:  # one combination that a solver refuses must not end the others
                        print(f"{source} {name} {engine} on {where} K {samples}: {type(error).__name__}: {error}")
                        continue
                    print_rows(rows[-1:])
                    if args.json:
                        args.json.write_text(json.dumps(_report(rows), indent=1))
    print_rows(rows)
    if args.plot:
        from plot_engines import plot_rows

        plot_rows(rows, args.plot)


def _report(rows: list[dict]) -> dict:
    packages = ("warpmpc", "warp-lang", "newton", "mujoco", "mujoco-warp")
    return {
        "date": time.strftime("%Y-%m-%d"),
        "versions": {package: version(package) for package in packages},
        "mujoco": mujoco.__version__,
        "rows": rows,
    }


if __name__ == "__main__":
    main()
