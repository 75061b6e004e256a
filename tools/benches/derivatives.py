# SPDX-License-Identifier: Apache-2.0
r"""How long the derivatives of a whole horizon take, beside MuJoCo's own on the same cores.

    python tools/bench.py derivatives
    python tools/bench.py derivatives --scenes humanoid_stand:40 --threads 1
    python tools/bench.py derivatives --gpu

MuJoCo's are ``mjd_transitionFD``, centred, at every physics step of the horizon, shared among as many threads; ours are
of whole control steps, of one physics step each here, with the residuals' derivatives. Medians over --times.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import mujoco
import numpy as np
import warp as wp
from shared.machine import machine

from warpmpc import Controller, Scene, load_scene
from warpmpc.planner.derivatives.rollouts import Policy
from warpmpc.planner.refine import Refiner
from warpmpc.scene.overrides import with_values

SCENES = ("cartpole_swingup:75", "panda_reach:64", "humanoid_stand:40", "quadruped_walk:40")


def refiner(scene: Scene, engine: str, device: str = "cpu") -> Refiner:
    """What takes derivatives of a scene's plans."""
    return Controller(scene, device=device, engine=engine).plan_step.refiner


def horizon(found: Refiner) -> tuple[np.ndarray, np.ndarray]:
    """States [1, T, nx] and controls [1, T, nu] along a rollout from the start of the scene, under gentle noise."""
    rng, layout = np.random.default_rng(0), found.layout
    steps, nu = found.horizon, layout.nu
    middle, half = (0.5 * (layout.control_upper + sign * layout.control_lower) for sign in (1.0, -1.0))
    control = (middle + 0.05 * half * rng.standard_normal((1, steps, nu))).astype(np.float32).astype(float)
    rollouts, start = found.rollouts, found.rollouts.worlds.observed()
    gain, states = np.zeros((1, steps, nu, found.tangent.size)), np.ones((1, steps, found.tangent.width))
    outcome = rollouts(start, control[:, 0], Policy(states, control, 0.0 * control, gain), np.zeros(8), 0.0)
    return outcome.state[:, 0, :-1], control


def mujocos(found: Refiner, states: np.ndarray, control: np.ndarray, threads: int) -> Callable[[], None]:
    """MuJoCo's own derivatives of the same steps."""
    world = found.rollouts.worlds.world
    m, n = world.model, found.tangent.size
    ctrl = control[0] @ world.actuator_matrix.T + world.actuator_offset
    data = [mujoco.MjData(m) for _ in range(threads)]
    a, b = np.zeros((n, n)), np.zeros((n, m.nu))
    parts = np.array_split(np.arange(len(ctrl)), threads)
    pool = ThreadPoolExecutor(threads)

    def part(thread: int) -> None:
        own = a.copy(), b.copy()
        for t in parts[thread]:
            row = np.concatenate([[0.0], states[0, t]])
            mujoco.mj_setState(m, data[thread], row, mujoco.mjtState.mjSTATE_FULLPHYSICS)
            data[thread].ctrl[:] = ctrl[t]
            mujoco.mjd_transitionFD(m, data[thread], 1e-6, True, *own, None, None)

    return lambda: list(pool.map(part, range(threads)))


def median(work: Callable[[], object], times: int) -> float:
    """Wall time of some work [ms]."""
    taken = []
    for _ in range(times + 2):
        start = time.perf_counter()
        work()
        taken.append(1e3 * (time.perf_counter() - start))
    return float(np.median(taken[2:]))


def main(arguments: list[str]) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), metavar="SCENE:STEPS")
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--times", type=int, default=15)
    parser.add_argument("--gpu", action="store_true", help="also with fused on the first GPU")
    args = parser.parse_args(arguments)
    ours = [("mujoco", "cpu"), ("fused", "cpu"), *([("fused", "cuda:0")] if args.gpu else [])]
    print(
        f"{args.threads} threads of {machine()['cpu']}"
        + (f"; {wp.get_device('cuda:0').name}" if args.gpu else "")
        + "\n"
    )
    columns = ["scene, steps", "worlds", "mjd_transitionFD", *(f"{engine}, {device}" for engine, device in ours)]
    print(f"| {' | '.join(columns)} |\n{'|---' * len(columns)}|")
    for given in args.scenes:
        name, steps = given.rsplit(":", 1)
        sizes = {"planner.horizon": int(steps), "engine.substeps": 1, "engine.threads": args.threads}
        scene = with_values(load_scene(name), {"planner.method": "ilqg", "planner.samples": 16, **sizes})
        exact = refiner(scene, "mujoco")
        states, control = horizon(exact)
        own = median(mujocos(exact, states, control, args.threads), args.times)
        row = [f"`{name}`, {steps}", str(exact.differences.worlds.shape.worlds), f"{own:.1f} ms"]
        for engine, device in ours:
            found = exact if engine == "mujoco" else refiner(scene, engine, device)
            taken = median(partial(found.differences, states, control, control[:, 0]), args.times)
            row.append(f"{taken:.1f} ms ({taken / own:.2f}×)")
        print(f"| {' | '.join(row)} |", flush=True)
    return 0
