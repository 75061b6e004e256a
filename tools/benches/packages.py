# SPDX-License-Identifier: Apache-2.0
"""Single steps of ``warpmpc.physics.rollout`` against ``mujoco.rollout``, for every model of installed packages.

    python tools/bench.py packages --jobs 16 --json packages.json    # goes on where it was interrupted
    python tools/bench.py packages --only dm_control example-robot-data/panda

From states that MuJoCo visits under random controls, as single precision holds them, both take a step; MuJoCo's solver
and its search for contacts go on to their limits. The figure is the largest difference of a velocity in a state, over
the speed of its fastest joint where that is above one. MuJoCo's own is the larger of what it makes of its usual
tolerances and of joints that are off by 3e-7. Sensors that are not read are left out and named.
"""

from __future__ import annotations

import argparse
import copy
import json
import logging
import shlex
import subprocess
import sys
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor, as_completed
from datetime import date
from pathlib import Path
from typing import Any

import mujoco
import mujoco.rollout
import numpy as np
from rich.console import Console
from rich.table import Table
from shared.files import put_group, write_json
from shared.machine import machine
from shared.packages import load_file, package_files

from warpmpc.engine.mujoco import silence_mujoco
from warpmpc.physics import rollout
from warpmpc.physics.model import FEW_ITERATIONS, FEW_SEARCHES

COLUMNS = [
    "package", "models", "compared", "without some sensors", "refused", "p50: median", "p99: median", "worst",
    "MuJoCo's own there", "worst where that is below 1e-4",
]  # fmt: skip
"""Heads of the table about packages."""
SECONDS, TIMES, WORLDS = 0.4, 4, 48
"""Length of the way that states are taken from [s], how many of each world, and worlds."""
EDGE = 3e-7
"""Change of joints by which MuJoCo's own reply to rounding is seen [m, rad]."""
CALM = 1e-4
"""Own reply up to which a model is calm."""
PATIENCE = 600
"""Longest time for a model [s]."""


def visited(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
    """States ``[N, 1+nq+nv+na]`` that worlds come by under random controls held, and those ``[N, 1, nu]``."""
    rng = np.random.default_rng(0)
    mujoco.mj_resetData(model, data)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    limited = model.actuator_ctrllimited.astype(bool)
    width = np.where(limited, 0.5 * np.ptp(model.actuator_ctrlrange, axis=1), 0.5)
    control = data.ctrl + 0.5 * width * rng.normal(size=(WORLDS, 1, model.nu))
    control = control.astype(np.float32).astype(float)
    start = np.concatenate([[0.0], data.qpos, data.qvel, data.act])
    starts = np.repeat(start[None], WORLDS, axis=0)
    starts[:, 1 + model.nq : 1 + model.nq + model.nv] += 0.1 * rng.normal(size=(WORLDS, model.nv))
    steps = max(TIMES, int(SECONDS / model.opt.timestep))
    states, _ = mujoco.rollout.rollout(model, data, starts, control, nstep=steps)
    chosen = states[:, np.linspace(0, steps - 1, TIMES + 1).astype(int)[1:]].reshape(-1, states.shape[-1])
    chosen = chosen.astype(np.float32).astype(float)
    controls = np.repeat(control, TIMES, axis=0)
    fine = np.isfinite(chosen).all(axis=1) & (np.abs(chosen[:, 1:]).max(axis=1) < 1e4)
    return chosen[fine], controls[fine]


def compare(name: str) -> dict[str, Any]:
    """Differences of single steps of a model, or why there are none."""
    silence_mujoco()
    try:
        model = load_file(name)
    except Exception as error:
        return {"model": name, "unloaded": _plain(str(error))}
    if not model.nv:
        return {"model": name, "unloaded": "nothing moves"}
    out: dict[str, Any] = {"model": name, "dofs": int(model.nv), "integrator": int(model.opt.integrator)}
    lack = rollout.lacking(model)
    if lack and lack.startswith("sensors "):
        out["sensors"] = lack.removeprefix("sensors of the kinds ")
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
        lack = rollout.lacking(model)
    if lack:
        return out | {"refused": lack}
    said: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: said.append(record.getMessage())
    logging.getLogger("warpmpc").addHandler(handler)
    exact = copy.copy(model)
    exact.opt.ccd_tolerance, exact.opt.ccd_iterations = 1e-12, 400
    if model.opt.iterations >= FEW_ITERATIONS and model.opt.ls_iterations >= FEW_SEARCHES:  # else both end before
        exact.opt.tolerance, exact.opt.iterations = 0.0, 200
        exact.opt.ls_tolerance, exact.opt.ls_iterations = 1e-10, 100
    data = mujoco.MjData(model)
    states, control = visited(model, data)
    rows, depth = [], []
    for state in states:
        mujoco.mj_setState(model, data, state, int(mujoco.mjtState.mjSTATE_FULLPHYSICS))
        mujoco.mj_forward(model, data)
        rows.append(data.nefc)
        depth.append(-min(data.contact.dist.min(initial=0.0), 0.0))
    near = states.copy()
    near[:, 1 : 1 + model.nq] += EDGE * np.random.default_rng(1).choice([-1.0, 1.0], (len(states), model.nq))
    begin = time.perf_counter()
    with rollout.Rollout(fall_back=False) as pool:
        ours = _velocities(model, pool.rollout(model, data, states, control)[0])
    compiled = time.perf_counter() - begin
    first, usual, moved = (
        _velocities(model, mujoco.rollout.rollout(m, data, s, control)[0])
        for m, s in ((exact, states), (model, states), (exact, near))
    )
    scale = np.maximum(1.0, np.abs(first).max(axis=1))
    for key, values in (("apart", ours), ("tolerance", usual), ("rounding", moved)):
        gap = np.nan_to_num(np.abs(values - first).max(axis=1) / scale, nan=np.inf)
        out[key] = {f"p{p}": float(np.percentile(gap, p)) for p in (50, 99, 100)}
    return out | {
        "states": len(states),
        "constrained": float(np.mean(np.array(rows) > 0)),
        "depth_p50": float(np.median(depth)),
        "compile_s": compiled,
        **({"said": said} if said else {}),
    }


def _velocities(model: mujoco.MjModel, states: np.ndarray) -> np.ndarray:
    return states[:, 0, 1 + model.nq : 1 + model.nq + model.nv]


def _plain(error: str) -> str:
    """The first line of an error, without folders."""
    line = (error.strip().splitlines() or ["?"])[0]
    return " ".join(word.rsplit("/", 1)[-1] for word in line.split())[:160]


def in_process(name: str) -> dict[str, Any]:
    """:func:`compare` in a separate process, which may die or take too long."""
    command = [sys.executable, str(Path(__file__).parents[1] / "bench.py"), "packages", "--one", name]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
    except subprocess.TimeoutExpired:
        return {"model": name, "unloaded": f"takes more than {PATIENCE} s"}
    lines = done.stdout.strip().splitlines()
    if done.returncode or not lines:
        last = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
        return {"model": name, "unloaded": _plain(last)}
    return json.loads(lines[-1])


def print_results(results: list[dict[str, Any]]) -> None:
    """Print what came of each package, the models that are furthest apart, and what was refused and why."""
    console = Console(width=150)
    table = Table(*COLUMNS)
    for row in summary(results):
        table.add_row(*row)
    console.print(table)
    table = Table("furthest apart", "dofs", "p50", "p99", "tolerance p99", "rounding p99", "depth p50 [m]")
    done = sorted((r for r in results if "apart" in r), key=lambda r: -r["apart"]["p99"])
    for r in done[:12]:
        figures = (r["apart"]["p50"], *(r[key]["p99"] for key in ("apart", "tolerance", "rounding")))
        table.add_row(r["model"], str(r["dofs"]), *(f"{x:.0e}" for x in (*figures, r["depth_p50"])))
    console.print(table)
    for why, count in Counter(r["refused"] for r in results if "refused" in r).most_common():
        console.print(f"refused, {count}: {why}", markup=False)


def summary(results: list[dict[str, Any]]) -> list[list[str]]:
    """Rows of a table about packages, of :data:`COLUMNS`."""
    packages: dict[str, list[dict[str, Any]]] = {}
    for r in results:
        if "unloaded" not in r:
            packages.setdefault(r["model"].split("/")[0], []).append(r)
    table = []
    for package, rows in packages.items():
        done = [r for r in rows if "apart" in r]
        counts = [len(rows), len(done), sum("sensors" in r for r in done), len(rows) - len(done)]
        p50, p99 = ([r["apart"][p] for r in done] for p in ("p50", "p99"))
        figures = [np.median(p50), np.median(p99), max(p99)] if done else []
        if done:
            own = [max(r["rounding"]["p99"], r["tolerance"]["p99"]) for r in done]
            calm = [x for x, y in zip(p99, own, strict=True) if y <= CALM]
            figures += [own[int(np.argmax(p99))], max(calm, default=np.nan)]
        table.append([package, *map(str, counts), *(f"{x:.0e}" for x in figures), *[""] * (5 * (not done))])
    return table


def main(arguments: list[str]) -> None:
    """Compare models and print tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[""], help="beginnings of names, PACKAGE/FILE")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=np.inf, help="begin no more models after so many")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--docs", type=Path, metavar="FOLDER", help="put the packages' table there, as packages.json")
    options = parser.parse_args(arguments)
    if options.one:
        print(json.dumps(compare(options.one)))
        return
    known = json.loads(options.json.read_text())["results"] if options.json and options.json.exists() else []
    results = {r["model"]: r for r in known}
    names = [n for n in package_files() if n.startswith(tuple(options.only)) and n not in results]
    end, before = time.monotonic() + 60.0 * options.minutes, machine()

    def unless_late(name: str) -> dict[str, Any] | None:
        return in_process(name) if time.monotonic() < end else None

    with ThreadPoolExecutor(options.jobs) as pool:
        try:
            for future in as_completed([pool.submit(unless_late, name) for name in names]):
                if found := future.result():
                    results[found["model"]] = found
                    if options.json:
                        rows = [results[n] for n in sorted(results)]
                        write_json(options.json, {"machine": before, "results": rows})
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    found = [results[n] for n in sorted(results)]
    print_results(found)
    if options.docs:
        command = shlex.join(["python", "tools/bench.py", "packages", *arguments])
        group = {
            "machine": f"{before['cpu']}, {before['cores']} cores",
            "date": date.today().isoformat(),
            "command": command,
            "rows": summary(found),
        }
        wanted = [n for n in package_files() if n.startswith(tuple(options.only))]
        if left := sum(n not in results for n in wanted):
            group["note"] = f"{left} of {len(wanted)} files were not reached"
        put_group(options.docs / "packages.json", COLUMNS, group)
