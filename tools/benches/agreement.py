# SPDX-License-Identifier: Apache-2.0
"""Roll the same states and controls through several engines and tell how far apart they are after each step.

The reference is MuJoCo's C engine. Every other engine gets the same randomized worlds, the same observed state and the
same sampled controls of a plan; the differences are taken world by world after every step of the horizon. The engine
``mujoco/rounded`` is the reference again, started from joints that are off by the rounding of single precision: where
it drifts as far as another engine, the scene is chaotic and the other engine's physics is not to blame.

    python tools/bench.py agreement omni_push_box --engines mujoco/rounded,mujoco_warp,newton --device cuda:0
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import warp as wp
from rich.console import Console
from rich.table import Table
from shared.files import write_json

import warpmpc
from warpmpc.scene.model.compiled import compile_scene

ROUNDED = "mujoco/rounded"
"""The reference, started from rounded joints."""
ROUNDING = 2.0**-24
"""Relative error of a number in single precision."""
QUANTITIES = {"joint_q": "joints [m, rad]", "position": "bodies [m]", "force": "contact force [N]"}


def visited(scene: warpmpc.Scene, compiled, *, seconds: float, count: int) -> list[warpmpc.State]:
    """States of a closed-loop run, evenly spaced: the object has been touched in some of them."""
    controller = warpmpc.Controller(scene, engine="mujoco", compiled=compiled)
    plant = warpmpc.Plant(scene, compiled=compiled)
    states = []
    while not plant.done and plant.time < seconds:
        states.append(plant.observe())
        plant.apply(controller.step(states[-1]))
    controller.engine.close()
    return [states[i] for i in np.linspace(0, len(states) - 1, count).round().astype(int)]


def recorded(controller: warpmpc.Controller) -> dict[str, np.ndarray]:
    """What an engine recorded, as ``[T, W, n]`` arrays."""
    out = controller.engine.simulator.trajectory
    steps, worlds = out.contact_force.shape[:2]
    return {
        "joint_q": out.joint_q.numpy()[1:].astype(float),
        "position": out.body_q.numpy()[1:, :, :, :3].reshape(steps, worlds, -1).astype(float),
        "force": out.contact_force.numpy().reshape(steps, worlds, -1).astype(float),
    }


def differences(source: str, engine: str, *, device: str, samples: int, seconds: float, states: int = 6) -> dict:
    """Differences of an engine from MuJoCo's C engine on a scene.

    Args:
        source: Scene and variant.
        engine: An engine's name, ``newton/SOLVER`` or ``mujoco/rounded``.
        device: Device of the engine.
        samples: Worlds rolled out from every state.
        seconds: Length of the closed-loop run that states are taken from [s].
        states: Number of states.

    Returns:
        By quantity, percentiles over worlds and states of the largest difference after each step, ``[T]`` lists.
    """
    name, _, solver = (engine if engine != ROUNDED else "mujoco").partition("/")
    overrides = [f"planner.samples={samples}", *([f'engine.solver="{solver}"'] if solver else [])]
    scene = warpmpc.load_scene(source, overrides=overrides)
    compiled = compile_scene(scene)
    reference = warpmpc.Controller(scene, engine="mujoco", compiled=compiled)
    other = warpmpc.Controller(scene, engine=name, device="cpu" if engine == ROUNDED else device, compiled=compiled)
    noise = np.random.default_rng(0)
    found: dict[str, list[np.ndarray]] = {quantity: [] for quantity in QUANTITIES}
    for state in visited(scene, compiled, seconds=seconds, count=states):
        reference.step(state)
        control = wp.clone(reference.engine.recorded.control, device=other.engine.device)
        ours = recorded(reference)
        if engine == ROUNDED:
            state = replace(
                state, joint_q=state.joint_q * (1.0 + ROUNDING * noise.uniform(-1.0, 1.0, state.joint_q.shape))
            )
        other.step(state)
        other.engine.simulator.clone(other.plan_step.state)
        other.engine.simulator.rollout(control)
        theirs = recorded(other)
        for quantity, values in found.items():
            gap = np.nan_to_num(np.abs(ours[quantity] - theirs[quantity]), nan=np.inf)
            values.append(gap.max(axis=-1) if gap.shape[-1] else np.zeros(gap.shape[:2]))
    reference.engine.close()
    out = {"scene": source, "engine": engine, "device": device, "worlds": samples * states}
    for quantity, values in found.items():
        stacked = np.concatenate(values, axis=1)  # [T, worlds]
        out[quantity] = {f"p{p}": np.percentile(stacked, p, axis=1).tolist() for p in (50, 90, 99)}
    return out


def print_differences(rows: list[dict]) -> None:
    """The differences after the first step and at the end of the horizon."""
    table = Table(box=None, title="difference from MuJoCo's C engine, p50 / p90 / p99 of worlds")
    for head in ("scene", "engine", "worlds", "after", *QUANTITIES.values()):
        table.add_column(head, justify="left" if head in ("scene", "engine") else "right")
    for row in rows:
        for step, label in ((0, "1 step"), (-1, f"{len(row['joint_q']['p50'])} steps")):
            cells = [" / ".join(f"{row[q][p][step]:.2g}" for p in ("p50", "p90", "p99")) for q in QUANTITIES]
            table.add_row(row["scene"], row["engine"], str(row["worlds"]), label, *cells)
    Console(width=140).print(table)


def main(arguments: list[str]) -> None:
    """Compare and report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--engines", default="mujoco_warp", help="names, newton/xpbd, ...; separated by commas")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--seconds", type=float, default=8.0, help="length of the run that states are taken from")
    parser.add_argument("--states", type=int, default=6)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args(arguments)
    device = str(wp.get_preferred_device()) if args.device == "auto" else args.device
    rows = []
    for source in args.scenes:
        for engine in args.engines.split(","):
            try:
                rows.append(
                    differences(
                        source, engine, device=device, samples=args.samples, seconds=args.seconds, states=args.states
                    )
                )
            except warpmpc.SceneError as error:
                print(f"{source} on {engine}: {error}")
    print_differences(rows)
    if args.json:
        write_json(args.json, rows)
