#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Roll the same states and controls through several engines and tell how far apart they end.

The reference is MuJoCo's C engine. Every other engine gets the same randomized worlds, the same observed state and the
same sampled controls of a plan; the differences are taken world by world after every step of the horizon.

    python tools/agreement.py omni_push_box panda_reach --engines newton,newton/steel --device cuda:0
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import warp as wp
from rich.console import Console
from rich.table import Table

import warpmpc
from warpmpc.model.compiled import compile_scene

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
        engine: ``newton``, or ``newton/SOLVER``.
        device: Device of the engine.
        samples: Worlds rolled out from every state.
        seconds: Length of the closed-loop run that states are taken from [s].
        states: Number of states.

    Returns:
        By quantity, percentiles over worlds and states of the largest difference after each step, ``[T]`` lists.
    """
    name, _, solver = engine.partition("/")
    overrides = [f"planner.samples={samples}", *([f'engine.solver="{solver}"'] if solver else [])]
    scene = warpmpc.load_scene(source, overrides=overrides)
    compiled = compile_scene(scene)
    reference = warpmpc.Controller(scene, engine="mujoco", compiled=compiled)
    other = warpmpc.Controller(scene, engine=name, device=device, compiled=compiled)
    found: dict[str, list[np.ndarray]] = {quantity: [] for quantity in QUANTITIES}
    for state in visited(scene, compiled, seconds=seconds, count=states):
        reference.step(state)
        control = wp.clone(reference.engine.control, device=other.engine.device)
        ours = recorded(reference)
        other.step(state)
        other.engine.simulator.clone(other.planner.state)
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
    """The differences at the end of the horizon."""
    table = Table(
        box=None, title="difference from MuJoCo's C engine at the end of the horizon, p50 / p90 / p99 of worlds"
    )
    for head in ("scene", "engine", "worlds", *QUANTITIES.values()):
        table.add_column(head, justify="left" if head in ("scene", "engine") else "right")
    for row in rows:
        cells = [" / ".join(f"{row[q][p][-1]:.2g}" for p in ("p50", "p90", "p99")) for q in QUANTITIES]
        table.add_row(row["scene"], row["engine"], str(row["worlds"]), *cells)
    Console(width=140).print(table)


def main() -> None:
    """Compare and report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--engines", default="newton", help="newton, newton/steel, ...; separated by commas")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    device = str(wp.get_preferred_device()) if args.device == "auto" else args.device
    rows = []
    for source in args.scenes:
        for engine in args.engines.split(","):
            try:
                rows.append(differences(source, engine, device=device, samples=args.samples, seconds=args.seconds))
            except warpmpc.SceneError as error:
                print(f"{source} on {engine}: {error}")
    print_differences(rows)
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
