#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Time plans against the physics they cannot do without.

Runs scenes in closed loop on the engine ``mujoco``. After every plan the same rollouts (same models, states, controls,
threads) are made once more by one bare call of ``mujoco.rollout`` over all worlds; the ratio of the two is taken plan
by plan, so that a machine whose speed drifts does not distort it.

    python tools/bench.py                          # the shipped scenes
    python tools/bench.py omni_push_box:B --plans 400 --json bench.json
    python tools/bench.py my_scene.toml --terms my_terms.py --threads 8

For the engines on a GPU, over sample counts and solver settings, see tools/engines.py.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import mujoco.rollout
import numpy as np
from rich.console import Console
from rich.table import Table

import warpmpc
from warpmpc.cli.terms import TermsError, load_terms
from warpmpc.planner.step import STAGES
from warpmpc.run.episode import Episode
from warpmpc.scene.schema import EngineName

if TYPE_CHECKING:
    from collections.abc import Sequence

    from warpmpc import ArrayCost, CostTerm
    from warpmpc.engine.mujoco import MujocoEngine


class BareRollout:
    """The floor: one call of ``mujoco.rollout`` with an engine's own models and inputs, and nothing else.

    Args:
        engine: The simulator of the engine ``mujoco``.
    """

    def __init__(self, engine: MujocoEngine):
        self.engine = engine
        self.pool = mujoco.rollout.Rollout(nthread=engine.threads)
        self.data = [mujoco.MjData(engine.model) for _ in range(engine.threads)]
        self.state, self.sensor = np.empty_like(engine.state), np.empty_like(engine.sensor)

    def __call__(self) -> float:
        """Roll the engine's last inputs out again; returns the wall time [s]."""
        engine = self.engine
        start = time.perf_counter()
        self.pool.rollout(
            engine.models,
            self.data,
            engine.initial,
            engine.control,
            nstep=engine.steps,
            state=self.state,
            sensordata=self.sensor,
            skip_checks=True,
            control_spec=engine._control_spec,
        )
        return time.perf_counter() - start


def bench(
    name: str, overrides: list[str], *, plans: int, seed: int, terms: Sequence[CostTerm | ArrayCost] = ()
) -> dict:
    """Time the plans of one scene in closed loop.

    Args:
        name: Scene, with or without a variant.
        overrides: Changes of the scene, ``KEY=VALUE``.
        plans: Number of timed plans; a new episode starts when one ends.
        seed: Seed of the first episode.
        terms: Users' own cost terms that the scene names.
    """
    scene = warpmpc.load_scene(name, overrides=overrides)
    rows, floor = [], []
    while len(rows) < plans:
        episode = Episode(scene, seed=seed, engine="mujoco", terms=terms)
        controller, plant = episode.controller, episode.plant
        engine = controller.engine.simulator
        bare = BareRollout(engine)
        for _ in range(3):  # compile kernels, touch every page
            controller.step(plant.observe())
            bare()  # its threads and memory, too
        controller.reset()
        while not plant.done and len(rows) < plans:
            plant.apply(controller.step(plant.observe()))
            rows.append([controller.info.plan_ms, *(controller.info.stages_ms[stage] for stage in STAGES)])
            floor.append(1e3 * bare())
        if not np.array_equal(bare.state, engine.state):
            raise RuntimeError("the bare rollout did not repeat the plan's own: the comparison would be void")
        controller.engine.close()
        seed += 1
    total, *stages = np.array(rows).T
    stages = dict(zip(STAGES, stages, strict=True))
    floor = np.array(floor)
    shape = controller.shape
    return {
        "scene": name,
        "overrides": overrides,
        "engine": engine.name,
        "rollouts": shape.rollouts,
        "horizon": shape.horizon,
        "substeps": engine.substeps[0],
        "threads": engine.threads,
        "plans": len(rows),
        "physics_steps": engine.steps,
        "plan_ms": {f"p{p}": float(np.percentile(total, p)) for p in (50, 90, 99)},
        "stages_ms": {stage: float(np.median(value)) for stage, value in stages.items()},
        "floor_ms": {"p50": float(np.median(floor))},
        "evaluate_over_floor": float(np.median(stages["evaluate"] / floor)),
        "other_stages_share": float(np.median(1.0 - stages["evaluate"] / total)),
        "plan_over_floor": float(np.median(total / floor)),
        "plans_per_s": float(1e3 / np.median(total)),
        "us_per_world_step": float(1e3 * np.median(floor) / (shape.worlds * engine.steps)),
    }


def machine() -> dict:
    """Hardware and versions the figures belong to."""
    cpu = platform.processor()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if "model name" in line]
        cpu = names[0] if names else cpu
    packages = {name: version(name) for name in ("warpmpc", "newton", "warp-lang", "mujoco", "numpy")}
    return {"cpu": cpu, "cores": len(os.sched_getaffinity(0)), "python": platform.python_version(), **packages}


def table(results: list[dict]) -> Table:
    """The results as a table, times in milliseconds (medians)."""
    out = Table(title="plan time against bare mujoco.rollout, milliseconds (medians)")
    out.add_column("scene")
    columns = ["K × T × substeps", "plan p50", "p99", *STAGES]
    columns += ["bare rollout", "plan / bare", "evaluate / bare", "other stages"]
    for column in columns:
        out.add_column(column, justify="right")
    for r in results:
        out.add_row(
            r["scene"],
            f"{r['rollouts']} × {r['horizon']} × {r['physics_steps'] // r['horizon']}",
            f"{r['plan_ms']['p50']:.1f}",
            f"{r['plan_ms']['p99']:.1f}",
            *(f"{r['stages_ms'][stage]:.2f}" for stage in STAGES),
            f"{r['floor_ms']['p50']:.1f}",
            f"{r['plan_over_floor']:.3f}",
            f"{r['evaluate_over_floor']:.3f}",
            f"{100 * r['other_stages_share']:.1f} %",
        )
    return out


def with_physics() -> list[str]:
    """The shipped scenes whose rollouts are physics; ``tools/bench_kinematic.py`` is for the others."""
    return [n for n in warpmpc.shipped_scenes() if warpmpc.load_scene(n).engine.name is not EngineName.KINEMATIC]


def main() -> None:
    """Command line of this tool."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", help="scenes, with or without variants; all shipped ones by default")
    parser.add_argument("--plans", type=int, default=200, help="timed plans per scene (default 200)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first episode")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument(
        "--terms", action="append", default=[], type=Path, metavar="FILE", help="Python file of your own cost terms"
    )
    parser.add_argument("--threads", type=int, help="CPU threads of plan and floor (default: one per core)")
    parser.add_argument("--json", type=Path, help="also write the results to this file")
    args = parser.parse_args()
    console = Console(width=150)
    overrides = [*args.overrides, *([f"engine.threads={args.threads}"] if args.threads is not None else [])]
    try:
        terms = load_terms(args.terms)
    except TermsError as error:
        parser.error(str(error))
    results = []
    for name in args.scenes or with_physics():
        try:
            results.append(bench(name, overrides, plans=args.plans, seed=args.seed, terms=terms))
        except warpmpc.SceneError as error:
            console.print(f"{name}: skipped: {error}", style="yellow", markup=False)
    console.print(table(results))
    report = {"machine": machine(), "results": results}
    console.print(", ".join(f"{k} {v}" for k, v in report["machine"].items()), style="dim")
    if args.json:
        args.json.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
