# SPDX-License-Identifier: Apache-2.0
"""Time the physics of the engine ``fused`` alone: on one core beside ``mujoco.rollout``, on a GPU beside MuJoCo Warp.

    python tools/bench.py physics                                    # all models, one core
    python tools/bench.py physics quadruped omni_push_box --worlds 64 512 --json out.json
    python tools/bench.py physics arm_with_box quadruped humanoid --device cuda:0 --worlds 8192

Both sides step the same model from the same states with the same controls, in turns; the medians of the runs are
compared. Bodies lie, lean and collide: states are taken after a while of random controls. MuJoCo Warp's steps are one
CUDA graph, and so is the launch of ``fused``. For whole plans: tools/bench.py plans, warpmpc bench.
"""

from __future__ import annotations

import argparse
import copy
import time
from collections.abc import Callable
from pathlib import Path

import mujoco
import mujoco.rollout
import numpy as np
import warp as wp
from rich.console import Console
from rich.table import Table
from shared.files import write_json
from shared.machine import machine
from shared.models import FULL, OTHERS, OWN, SCENES, load_model, spread
from shared.plain_rollout import PlainRollout

from warpmpc.cli.setup import start_warp
from warpmpc.engine.fused_physics import shares
from warpmpc.engine.mujoco import silence_mujoco

STATES = 512
"""States that the worlds of a GPU start from, each in as many worlds as it takes."""


def physics(name: str, worlds: int, *, steps: int, runs: int, lanes: int | None = None) -> dict:
    """Microseconds of a world-step on one thread, of ``fused`` and ``mujoco.rollout``.

    Args:
        name: One of the models here, or a shipped scene.
        worlds: Number of worlds.
        steps: Physics steps of a run.
        runs: Runs of each, in turns.
        lanes: Worlds in a number, as many as the processor likes if None.

    Raises:
        ValueError: If the engine lacks what the model has.
    """
    model = load_model(name)
    q, v, u = spread(model, worlds)
    engine = PlainRollout(model, worlds, steps, lanes=lanes)
    control = np.repeat(u[None], steps, axis=0)
    start = time.perf_counter()
    ours = engine(q, v, control)[0].copy()
    first = time.perf_counter() - start
    initial = np.zeros((worlds, mujoco.mj_stateSize(model, FULL)))
    initial[:, 1 : 1 + model.nq + model.nv] = np.hstack([q, v])
    other = copy.copy(model)
    data, given = mujoco.MjData(other), np.ascontiguousarray(control.transpose(1, 0, 2))
    state = np.zeros((worlds, steps, initial.shape[1]))
    with mujoco.rollout.Rollout(nthread=0) as rollout:

        def theirs() -> None:
            rollout.rollout(other, data, initial, given if model.nu else None, nstep=steps, state=state)

        times = _in_turns(engine.launch, theirs, runs)
    apart = np.abs(ours[-1] - state[:, -1, 1 : 1 + model.nq]).max(axis=1)
    return _result(name, model, worlds, steps, times, "mujoco_us") | {
        "device": "cpu",
        "lanes": engine._lanes,
        "first_call_s": first,
        "apart_p50": float(np.median(apart)),
    }


def physics_on_device(name: str, worlds: int, *, steps: int, runs: int, device: str) -> dict:
    """Microseconds of a world-step on a device, of ``fused`` and of MuJoCo Warp, each in one CUDA graph.

    Args:
        name: One of the models here, or a shipped scene.
        worlds: Number of worlds.
        steps: Physics steps of a run.
        runs: Runs of each, in turns.
        device: CUDA device; on the CPU, for tests, both run without a graph.

    Raises:
        ValueError: If the engine lacks what the model has.
    """
    model = load_model(name)
    q, v, u = (np.resize(values, (worlds, values.shape[1])) for values in spread(model, min(worlds, STATES)))
    engine = PlainRollout(model, worlds, steps, device=device, share=shares(model, worlds))
    start = time.perf_counter()
    ours = engine(q, v, np.repeat(u[None], steps, axis=0))[0][-1].copy()
    first = time.perf_counter() - start
    other = WarpSteps(model, q, v, u, steps=steps, device=device)
    fused = captured(engine.launch, device)

    def run_ours() -> None:
        fused()
        wp.synchronize_device(device)

    times = _in_turns(run_ours, other.run, runs, before=other.reset)
    apart = np.abs(ours - other.data.qpos.numpy()).max(axis=1)
    return _result(name, model, worlds, steps, times, "mujoco_warp_us") | {
        "device": wp.get_device(device).name,
        "shared": engine._sharing > 1,
        "first_call_s": first,
        "apart_p50": float(np.median(apart)),
        "overflow": int(other.data.overflow.numpy().max()) if hasattr(other.data, "overflow") else 0,
    }


class WarpSteps:
    """Steps of MuJoCo Warp from given states, one CUDA graph of them.

    There is room for one and a half times the contacts and rows that MuJoCo C finds on the way.

    Args:
        model: The model.
        q: Coordinates at the start ``[W, nq]``.
        v: Velocities at the start ``[W, nv]``.
        u: Controls, held ``[W, nu]``.
        steps: Number of steps.
        device: Warp device.
    """

    def __init__(self, model: mujoco.MjModel, q: np.ndarray, v: np.ndarray, u: np.ndarray, *, steps: int, device: str):
        import mujoco_warp

        self.device, self._given = device, {"qpos": q, "qvel": v, "ctrl": u}
        contacts, rows = most_constraints(model, q, v, u, steps)
        with wp.ScopedDevice(device):
            self.model = mujoco_warp.put_model(model)
            self.model.opt.warn_overflow = 0
            room = {"nconmax": 4 + 3 * contacts // 2, "njmax": 8 + 3 * rows // 2}
            self.data = mujoco_warp.make_data(model, nworld=len(q), **room)

            def step() -> None:
                for _ in range(steps):
                    mujoco_warp.step(self.model, self.data)

            self.reset()
            if wp.get_device(device).is_cuda:
                mujoco_warp.step(self.model, self.data)  # compiles
            self._run = captured(step, device)
        self.reset()

    def reset(self) -> None:
        """Back to the start; not part of what is timed."""
        for name, values in self._given.items():
            if values.size:
                getattr(self.data, name).assign(values.astype(np.float32))
        self.data.qacc_warmstart.zero_()
        self.data.time.zero_()
        wp.synchronize_device(self.device)

    def run(self) -> None:
        """All steps."""
        with wp.ScopedDevice(self.device):
            self._run()
        wp.synchronize_device(self.device)


def captured(run: Callable[[], None], device: str) -> Callable[[], None]:
    """A function's launches as one CUDA graph; the function itself on a CPU."""
    if not wp.get_device(device).is_cuda:
        return run
    with wp.ScopedCapture(device=device) as capture:
        run()
    return lambda: wp.capture_launch(capture.graph)


def most_constraints(model: mujoco.MjModel, q: np.ndarray, v: np.ndarray, u: np.ndarray, steps: int) -> tuple[int, int]:
    """Most contacts and constraint rows at once that MuJoCo C has in some of the worlds."""
    data, contacts, rows = mujoco.MjData(model), 1, 1
    for w in range(min(len(q), 128)):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = q[w], v[w], u[w]
        for _ in range(steps):
            mujoco.mj_step(model, data)
            contacts, rows = max(contacts, data.ncon), max(rows, data.nefc)
    return contacts, rows


def _in_turns(
    ours: Callable[[], None], theirs: Callable[[], None], runs: int, before: Callable[[], None] | None = None
) -> tuple[list[float], list[float]]:
    """Wall times of two functions, called in turn [s]; ``before`` is called before the second."""
    times: tuple[list[float], list[float]] = [], []
    for _ in range(runs):
        for function, into in zip((ours, theirs), times, strict=True):
            if function is theirs and before is not None:
                before()
            begin = time.perf_counter()
            function()
            into.append(time.perf_counter() - begin)
    return times


def _result(name: str, model: mujoco.MjModel, worlds: int, steps: int, times: tuple, other: str) -> dict:
    ours, theirs = map(np.array, times)
    each = 1e6 / (worlds * steps)
    return {
        "model": name,
        "worlds": worlds,
        "steps": steps,
        "dofs": int(model.nv),
        "fused_us": each * float(np.median(ours)),
        other: each * float(np.median(theirs)),
        "fused_ms": 1e3 * float(np.median(ours)),
        "ratio": float(np.median(theirs / ours)),
    }


def main(arguments: list[str]) -> None:
    """Time models and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", nargs="*", help=f"models ({', '.join(OWN | OTHERS)}), scenes; all by default")
    parser.add_argument("--worlds", type=int, nargs="+", default=[512])
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--runs", type=int, default=7)
    parser.add_argument("--lanes", type=int, choices=(1, 4, 8, 16), help="worlds in a number, on a CPU")
    parser.add_argument("--device", help="beside MuJoCo Warp on this device, rather than mujoco.rollout on one core")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    silence_mujoco()
    start_warp()
    results, before = [], machine()
    other = "MuJoCo Warp" if options.device else "mujoco.rollout"
    table = Table("model", "worlds", "dofs", "fused [µs]", other, "ratio", "apart", "first call [s]")
    many = {"steps": options.steps, "runs": options.runs}
    for name in options.name or (*OWN, *OTHERS, *SCENES):
        for worlds in options.worlds:
            try:
                if options.device:
                    r = physics_on_device(name, worlds, device=options.device, **many)
                else:
                    r = physics(name, worlds, lanes=options.lanes, **many)
            except ValueError as error:
                results.append({"model": name, "refused": str(error)})
                table.add_row(name, str(worlds), "", str(error))
                continue
            results.append(r)
            figures = [f"{r[key]:.2f}" for key in ("fused_us", "mujoco_warp_us" if options.device else "mujoco_us")]
            figures += [f"{r['ratio']:.1f}", f"{r['apart_p50']:.0e}", f"{r['first_call_s']:.1f}"]
            table.add_row(name, str(worlds), str(r["dofs"]), *figures)
    console = Console(width=150)
    console.print(table)
    after = machine()
    load = f"load {before['load'][0]:.1f} before, {after['load'][0]:.1f} after"
    console.print(f"{load}, {after['cores']} cores, {after['cpu']}")
    if options.json:
        told = {"machine": before, "load_after": after["load"], "results": results}
        write_json(options.json, told)
