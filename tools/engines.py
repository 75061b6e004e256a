#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
r"""Time plans on every engine against the same physics alone, over sample counts and solver options.

States come from a closed-loop run of the scene, so that contacts are in play. Every plan is followed by the bare
physics with the same worlds, states and controls: for ``newton`` the same solver steps in a CUDA graph of their own,
for ``mujoco`` a bare call of ``mujoco.rollout``. Ratios are taken pair by pair.

    python tools/engines.py omni_push_box --samples 128,500,2048 --horizon 8 --json engines.json --plot engines.png
    python tools/engines.py omni_push_box --engines newton --samples 500 \\
        --case default: --case 'euler:engine.options.integrator="euler"'
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from importlib.metadata import version
from pathlib import Path

import mujoco
import numpy as np
import warp as wp
from bench import BareRollout
from rich.console import Console
from rich.table import Table

import warpmpc
from warpmpc.model.compiled import compile_scene
from warpmpc.planner.step import STAGES

STATES = 12
"""States from the closed-loop run that the plans are made from, in turn."""


def visited_states(source: str, seconds: float, seed: int = 0) -> list[warpmpc.State]:
    """States of a closed-loop run on the ``mujoco`` engine, evenly spaced over its first ``seconds``."""
    scene = warpmpc.load_scene(source)
    compiled = compile_scene(scene)
    controller = warpmpc.Controller(scene, engine="mujoco", seed=seed, compiled=compiled)
    plant = warpmpc.Plant(scene, seed=seed, compiled=compiled)
    states = []
    while not plant.done and plant.time < seconds:
        states.append(plant.observe())
        plant.apply(controller.step(states[-1]))
    controller.engine.close()
    return [states[i] for i in np.linspace(0, len(states) - 1, STATES).round().astype(int)]


class BareGraph:
    """The floor of the newton engine: the same solver steps captured alone."""

    def __init__(self, engine):
        self.device = wp.get_device(engine.device)
        if self.device.is_cuda:
            with wp.ScopedCapture(device=self.device) as capture:
                engine.step_physics()
            self._run = lambda: wp.capture_launch(capture.graph)
        else:
            self._run = engine.step_physics

    def __call__(self) -> float:
        """Step the engine's last rollouts again; returns the wall time [s]."""
        start = time.perf_counter()
        self._run()
        wp.synchronize_device(self.device)
        return time.perf_counter() - start


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


def measure(source: str, case: str, overrides: list[str], engine: str, device: str, args, states) -> dict:
    """Time one engine on one scene; times in milliseconds."""
    scene = warpmpc.load_scene(source, overrides=overrides)
    compiled = compile_scene(scene)
    cuda = engine == "newton" and wp.get_device(device).is_cuda
    free = wp.get_device(device).free_memory if cuda else 0
    began = time.perf_counter()
    controller = warpmpc.Controller(
        scene, engine=engine, device=device if engine == "newton" else "cpu", envs=args.envs, compiled=compiled
    )
    if args.envs > 1:
        states = [
            warpmpc.State(np.tile(s.joint_q, (args.envs, 1)), np.tile(s.joint_qd, (args.envs, 1)), s.time)
            for s in states
        ]
    controller.step(states[0])
    controller.step(states[0])
    ready = time.perf_counter() - began
    simulator = controller.engine.simulator
    bare = BareGraph(simulator) if engine == "newton" else BareRollout(simulator)
    plan, floor = [], []
    for i in range(args.plans + 3):
        start = time.perf_counter()
        controller.step(states[i % len(states)])
        took = time.perf_counter() - start
        if i < 3:
            continue
        plan.append(1e3 * took)
        floor.append(1e3 * bare())
    shape = controller.shape
    steps = shape.worlds * sum(simulator.substeps)
    first = controller.info if args.envs == 1 else controller.info[0]
    row = {
        "scene": source,
        "case": case,
        "engine": engine,
        "solver": str(scene.engine.solver) if engine == "newton" else "mujoco (C)",
        "device": wp.get_device(controller.device).name if cuda else f"{platform.processor() or 'cpu'}",
        "envs": args.envs,
        "samples": shape.rollouts,
        "horizon": shape.horizon,
        "substeps": simulator.substeps[0],
        "overrides": overrides,
        "plan_ms": {name: float(np.percentile(plan, p)) for name, p in (("p50", 50), ("p99", 99))},
        "floor_ms": float(np.median(floor)),
        "ratio": float(np.median(np.array(plan) / floor)),
        "plans_per_s": 1e3 / float(np.median(plan)),
        "world_steps_per_s": 1e3 * steps / float(np.median(plan)),
        "stages_ms": stage_times(controller),
        "memory_MiB": (free - wp.get_device(device).free_memory) / 2**20 if cuda else None,
        "start_s": ready,
        "diverged": first.diverged_worlds,
        "overflow": int(simulator.trajectory.overflow.numpy().max()),
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
            f"{r['floor_ms']:.3f}",
            f"{r['ratio']:.3f}",
            f"{1e-6 * r['world_steps_per_s']:.2f}",
            "-" if r.get("error_mm") is None else " / ".join(f"{v:.1f}" for v in r["error_mm"].values()),
            "-" if r["memory_MiB"] is None else f"{r['memory_MiB']:.0f}",
        )
    Console(width=160).print(table)


def plot_rows(rows: list[dict], file: Path) -> None:
    """Plan time against samples, a line per scene, engine and case, with the floor dotted."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 4.5), layout="constrained")
    lines = sorted({(r["scene"], r["engine"], r["case"]) for r in rows})
    for scene, engine, case in lines:
        own = sorted((r for r in rows if (r["scene"], r["engine"], r["case"]) == (scene, engine, case)), key=_samples)
        k = [r["samples"] for r in own]
        (line,) = axes.loglog(
            k, [r["plan_ms"]["p50"] for r in own], "o-", label=" ".join((scene, engine, case)).strip()
        )
        axes.loglog(k, [r["floor_ms"] for r in own], ":", color=line.get_color())
    axes.set_xlabel("rollouts K")
    axes.set_ylabel("plan [ms], dotted: physics alone")
    axes.grid(which="both", alpha=0.3)
    axes.legend(fontsize=8)
    figure.savefig(file, dpi=130)


def _samples(row: dict) -> int:
    return row["samples"]


def main() -> None:
    """Measure and report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--engines", default="mujoco,newton")
    parser.add_argument("--device", default="auto", help="device of the newton engine")
    parser.add_argument("--samples", default="", help="sample counts, the scene's own when left out")
    parser.add_argument("--horizon", type=int)
    parser.add_argument("--envs", type=int, default=1)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--case", action="append", default=[], metavar="NAME:KEY=VALUE;...")
    parser.add_argument("--plans", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=8.0, help="length of the run that states are taken from")
    parser.add_argument("--fidelity", action="store_true", help="compare the newton engine's rollouts with MuJoCo's")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--plot", type=Path)
    args = parser.parse_args()

    device = str(wp.get_preferred_device()) if args.device == "auto" else args.device
    common = [*args.set, *([f"planner.horizon={args.horizon}"] if args.horizon else [])]
    rows = []
    for source in args.scenes:
        states = visited_states(source, args.seconds)
        for samples in args.samples.split(","):
            for case in args.case or [":"]:
                name, _, keys = case.partition(":")
                overrides = [
                    *common,
                    *([f"planner.samples={samples}"] if samples else []),
                    *filter(None, keys.split(";")),
                ]
                for engine in args.engines.split(","):
                    try:
                        rows.append(measure(source, name, overrides, engine, device, args, states))
                    except Exception as error:  # one combination that a solver refuses must not end the others
                        print(f"{source} {name} {engine} K {samples}: {type(error).__name__}: {error}")
                        continue
                    print_rows(rows[-1:])
                    if args.json:
                        args.json.write_text(json.dumps(_report(rows), indent=1))
    print_rows(rows)
    if args.plot:
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
