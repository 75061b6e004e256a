# SPDX-License-Identifier: Apache-2.0
"""Physics steps by ``warpmpc.physics``: one thread against ``mujoco.rollout``, many against other batched simulators.

    python tools/bench.py batched                                             # one thread of each, in turns
    python tools/bench.py batched --threads 0 --mjbatch PYTHON --envpool PYTHON --json batched.json    # all cores
    python tools/bench.py batched humanoid quadruped --threads 0 --mujoco-warp cuda:0 --worlds 512 2048 8192 --docs docs

One thread: ``rollout.Rollout`` of both, processor time. Several: ``BatchSimulator.step`` against ``mjbatch.Batch.step``
or MuJoCo Warp's CUDA graph on the same model and states, wall time. EnvPool takes no model and no states: it steps its
nearest task under random actions, which includes observations, rewards and resets. PYTHON is the interpreter of an
environment that has the package; mjbatch and EnvPool bring their own MuJoCo. The models have no sensors.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

import mujoco
import mujoco.rollout
import numpy as np
import warp as wp
from rich.console import Console
from rich.table import Table
from shared.files import put_group, write_json
from shared.machine import machine
from shared.models import (
    FULL,
    g1_spec,
    hand_spec,
    humanoid_spec,
    load_model,
    quadruped_spec,
    spread,
    warp_humanoid_spec,
)

from benches.physics import WarpSteps
from warpmpc.cli.setup import start_warp
from warpmpc.engine.mujoco import silence_mujoco
from warpmpc.physics import BatchSimulator, rollout
from warpmpc.physics.runtime.thread_pool import thread_count

SPECS = {
    "humanoid": humanoid_spec,
    "quadruped": quadruped_spec,
    "g1": g1_spec,
    "hand": hand_spec,
    "warp_humanoid": warp_humanoid_spec,
}
TASKS = {
    "humanoid": ("HumanoidStand-v1", 5),
    "quadruped": ("Go1JoystickFlatTerrain-v1", 5),
    "g1": ("G1JoystickFlatTerrain-v1", 10),
    "hand": ("HandReach-v3", 20),
    "warp_humanoid": ("HumanoidStand-v1", 5),
}
"""EnvPool's nearest task, and its physics steps of a control. The hand's model is the same one."""
_LATER = re.compile(r' input="\w+"')
"""Attributes of actuators that say what their gains say already; MuJoCo 3.14 does not know them."""
SMALL = 100_000
"""Largest array of a model that is handed over [bytes]."""


def without_sensors(name: str) -> mujoco.MjSpec:
    """A model's specification; its file may be read from anywhere."""
    spec = SPECS[name]()
    if spec.meshdir and not Path(spec.meshdir).is_absolute():
        spec.meshdir = str((Path(spec.modelfiledir) / spec.meshdir).resolve())
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    return spec


def bare_model(name: str) -> mujoco.MjModel:
    """A model without sensors."""
    model = load_model(name)
    return without_sensors(name).compile() if model.nsensor else model


def one_thread(name: str, *, worlds: int, steps: int, runs: int) -> dict[str, Any]:
    """Processor time of a world-step of both rollouts on one thread [µs], in turns."""
    model = bare_model(name)
    q, v, u = spread(model, worlds)
    start = np.zeros((worlds, mujoco.mj_stateSize(model, FULL)))
    start[:, 1 : 1 + model.nq + model.nv] = np.hstack([q, v])
    control = np.repeat(u[:, None], steps, axis=1)
    data = mujoco.MjData(model)
    with mujoco.rollout.Rollout(nthread=0) as theirs, rollout.Rollout(nthread=0, fall_back=False) as ours:
        pools: tuple[Callable, ...] = tuple(p.rollout for p in (ours, theirs))
        ends, spent = {}, {pool: [] for pool in pools}
        for run in range(runs + 1):
            for pool in pools:
                begin = time.process_time()
                states, _ = pool(model, data, start, control)
                spent[pool].append(time.process_time() - begin)
                if not run:
                    ends[pool] = states[:, -1, 1 : 1 + model.nq].copy()
    ours_us, theirs_us = (1e6 * min(spent[pool][1:]) / (worlds * steps) for pool in pools)
    gap = np.abs(ends[pools[0]] - ends[pools[1]]).max(axis=1)
    return {
        "model": name,
        "worlds": worlds,
        "dofs": int(model.nv),
        "threads": 1,
        "other": "mujoco.rollout",
        "version": mujoco.__version__,
        "warpmpc_us": ours_us,
        "other_us": theirs_us,
        "ratio": theirs_us / ours_us,
        "apart_p50": float(np.median(gap)),
    }


class Other(Protocol):
    """Another simulator."""

    kind: str
    version: str

    def run(self) -> dict[str, Any]:
        """Step from the start: ``seconds``, ``world_steps`` and, unless states are its own, ``qpos`` ``[8, nq]``."""

    def close(self) -> None:
        """Give back what it holds."""


class Elsewhere:
    """A simulator in a separate process.

    Args:
        python: Its interpreter.
        kind: ``mjbatch`` or ``envpool``.
        told: Arguments of its class in ``stepping.py``.

    Raises:
        ValueError: If it does not start.
    """

    def __init__(self, python: str, kind: str, told: dict[str, Any]):
        script = Path(__file__).parents[1] / "shared" / "stepping.py"
        self._process = subprocess.Popen(
            [python, str(script), kind], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.kind = kind
        self.version = self._ask(told)["version"]

    def run(self) -> dict[str, Any]:
        """Step from the start."""
        return self._ask(None)

    def _ask(self, told: dict[str, Any] | None) -> dict[str, Any]:
        self._process.stdin.write(json.dumps(told) + "\n")
        self._process.stdin.flush()
        while line := self._process.stdout.readline():
            if line.startswith("{"):
                return json.loads(line)
        raise ValueError(f"{self.kind} has ended with exit code {self._process.wait()}")

    def close(self) -> None:
        """End it."""
        self._process.stdin.close()
        self._process.wait()


class OnDevice:
    """MuJoCo Warp's steps on a device.

    Args:
        steps: The steps.
        count: Number of world-steps.
    """

    def __init__(self, steps: WarpSteps, count: int):
        self.kind, self.version = f"MuJoCo Warp, {wp.get_device(steps.device).name}", version("mujoco-warp")
        self._steps, self._count = steps, count

    def run(self) -> dict[str, Any]:
        """Step from the start."""
        self._steps.reset()
        begin = time.perf_counter()
        self._steps.run()
        spent = time.perf_counter() - begin
        qpos = self._steps.data.qpos.numpy()[:8].tolist()
        return {"seconds": spent, "world_steps": self._count, "qpos": qpos}

    def close(self) -> None:
        """Nothing is left to do."""


def hand_over(name: str, model: mujoco.MjModel, folder: Path, **arrays: np.ndarray) -> dict[str, str]:
    """Write a model and states for another version of MuJoCo."""
    spec = without_sensors(name)
    spec.compile()
    xml, numbers = folder / "model.xml", folder / "numbers.npz"
    xml.write_text(_LATER.sub("", spec.to_xml()), encoding="utf-8")
    for key in (k for k in dir(model) if not k.startswith("_")):
        value = getattr(model, key)
        if isinstance(value, np.ndarray) and value.dtype == np.float64 and value.nbytes < SMALL:
            arrays.setdefault(key, value)
    options = ("timestep", "integrator", "cone", "solver", "iterations", "tolerance", "ls_iterations", "ls_tolerance")
    arrays |= {f"opt.{key}": np.array(getattr(model.opt, key)) for key in options}
    np.savez(numbers, **arrays)
    return {"xml": str(xml), "arrays": str(numbers)}


def many_threads(
    name: str, others: dict[str, str], *, worlds: int, steps: int, runs: int, threads: int
) -> list[dict[str, Any]]:
    """World-steps per second of other simulators and of ``BatchSimulator``, in turns; a row for each other.

    Args:
        name: The model.
        others: ``mjbatch`` or ``envpool`` with its interpreter, ``mujoco_warp`` with its device.
        worlds: Number of worlds.
        steps: Physics steps of a run.
        runs: Runs of each.
        threads: Threads of a side; 0 for all cores.
    """
    model, rows = bare_model(name), []
    q, v, u = (np.resize(x, (worlds, x.shape[1])) for x in spread(model, min(worlds, 256)))
    sim = BatchSimulator(model, worlds, threads=threads)

    def ours() -> float:
        sim.reset(qpos=q, qvel=v)
        begin = time.perf_counter()
        sim.step(u, steps)
        return time.perf_counter() - begin

    for kind, where in others.items():
        told: dict[str, Any] = {"threads": threads, "steps": steps}
        other: Other
        with tempfile.TemporaryDirectory() as folder:
            if kind == "mujoco_warp":
                other = OnDevice(WarpSteps(model, q, v, u, steps=steps, device=where), worlds * steps)
            elif kind == "mjbatch":
                other = Elsewhere(where, kind, told | hand_over(name, model, Path(folder), q=q, v=v, u=u))
            else:
                told |= dict(zip(("task", "each"), TASKS[name], strict=True), worlds=worlds)
                other = Elsewhere(where, kind, told)
        own, theirs, answer = [], [], {}
        for _ in range(runs + 1):
            own.append(ours() / (worlds * steps))
            answer = other.run()
            theirs.append(answer["seconds"] / answer["world_steps"])
        ours_us, theirs_us = (1e6 * min(x[1:]) for x in (own, theirs))
        row = {"model": name, "worlds": worlds, "dofs": int(model.nv), "threads": thread_count(threads)}
        row |= {"other": other.kind, "version": other.version, "warpmpc_us": ours_us, "other_us": theirs_us}
        if "qpos" in answer:
            row["apart_p50"] = float(np.median(np.abs(np.array(answer["qpos"]) - sim.qpos[:8]).max(axis=1)))
        else:
            row["task"] = TASKS[name][0]
        rows.append(row | {"ratio": theirs_us / ours_us})
        other.close()
    return rows


FORMS = {"worlds": "{}", "warpmpc_us": "{:.3f}", "ratio": "{:.1f}"}
"""Figures of the documentation's table, and how they are written."""
COLUMNS = ["model", "other", "worlds", "warpmpc [µs a world-step]", "times as fast"]


def figures(report: dict[str, Any]) -> dict[str, Any]:
    """A group of rows of the documentation's table, one for each model and other simulator."""
    found: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for r in report["results"]:
        found.setdefault((r["model"], f"{r['other']} {r['version']}"), []).append(r)
    rows = [
        [*names, *(", ".join(form.format(r[key]) for r in part) for key, form in FORMS.items())]
        for names, part in found.items()
    ]
    threads = max(r["threads"] for r in report["results"])
    told = {"machine": f"{threads} thread{'s' * (threads > 1)} of {report['machine']['cpu']}", "date": report["date"]}
    return told | {"command": report["command"], "rows": rows}


def picture(results: list[dict[str, Any]], path: Path) -> None:
    """A panel for each model: times of a step of all worlds over their number, here and on MuJoCo Warp's device."""
    from matplotlib.figure import Figure

    models = list(dict.fromkeys(r["model"] for r in results))
    figure = Figure(figsize=(3.2 * len(models), 2.8), layout="constrained")
    for axes, name in zip(np.ravel(figure.subplots(1, len(models), squeeze=False)), models, strict=True):
        mine = sorted((r for r in results if r["model"] == name), key=lambda r: r["worlds"])
        worlds = [r["worlds"] for r in mine]
        for label, key in ((f"warpmpc, {mine[0]['threads']} threads", "warpmpc_us"), (mine[0]["other"], "other_us")):
            axes.loglog(worlds, [1e-3 * r[key] * r["worlds"] for r in mine], marker=".", label=label)
        axes.set_title(name, fontsize=9)
        axes.tick_params(labelsize=7)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7)
    figure.supxlabel("worlds", fontsize=9)
    figure.supylabel("step of all worlds [ms]", fontsize=9)
    figure.savefig(path, dpi=110)


def main(arguments: Sequence[str]) -> None:
    """Time models, print a table, write figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", nargs="*", default=list(SPECS), help=f"models ({', '.join(SPECS)}); all by default")
    parser.add_argument("--worlds", type=int, nargs="+", default=[512])
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--runs", type=int, default=7)
    parser.add_argument("--threads", type=int, default=1, help="of each side; 0 for all cores")
    parser.add_argument("--mjbatch", metavar="PYTHON", help="interpreter that has mjbatch")
    parser.add_argument("--envpool", metavar="PYTHON", help="interpreter that has EnvPool")
    parser.add_argument("--mujoco-warp", metavar="DEVICE", help="device of MuJoCo Warp's steps")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--docs", type=Path, help="folder of pages that get data/batched.json and batched.png")
    options = parser.parse_args(arguments)
    if unknown := sorted(set(options.name) - set(SPECS)):
        parser.error(f"no model {', '.join(unknown)}; there is: {', '.join(SPECS)}")
    silence_mujoco()
    start_warp()
    others = {kind: told for kind in ("mujoco_warp", "mjbatch", "envpool") if (told := getattr(options, kind))}
    command = re.sub(r" --(docs|json) \S+", "", " ".join(["python tools/bench.py batched", *arguments]))
    command = re.sub(r"(--mjbatch|--envpool) \S+", r"\1 PYTHON", command)
    report = {"date": time.strftime("%Y-%m-%d"), "command": command, "machine": machine(), "results": []}
    table = Table("model", "dofs", "worlds", "threads", "other", "warpmpc [µs]", "other [µs]", "ratio", "apart")
    for name in options.name:
        for worlds in options.worlds:
            many = {"worlds": worlds, "steps": options.steps, "runs": options.runs}
            rows = many_threads(name, others, threads=options.threads, **many) if others else [one_thread(name, **many)]
            for r in rows:
                apart = f"{r['apart_p50']:.0e}" if "apart_p50" in r else r["task"]
                told = [f"{r[key]:.3f}" for key in ("warpmpc_us", "other_us")]
                counts = map(str, (r["dofs"], r["worlds"], r["threads"]))
                table.add_row(name, *counts, f"{r['other']} {r['version']}", *told, f"{r['ratio']:.1f}", apart)
            report["results"] += rows
            if options.json:
                write_json(options.json, report)
    Console(width=150).print(table)
    if options.docs:
        put_group(options.docs / "data" / "batched.json", COLUMNS, figures(report))
        if options.mujoco_warp:
            picture(report["results"], options.docs / "batched.png")
