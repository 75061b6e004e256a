#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
r"""Warp's tape through Newton's differentiable solvers beside differences in parallel worlds: same numbers, which time?

    python tools/tape_derivatives.py

The arm of ``crocoddyl_reach.py`` and a cartpole, driven by torques, take one step from a state of its own in each of T
worlds. The tape gives all worlds' derivatives of one number of the end in one backward pass; the differences are those
of the same solver, by moving every number of the start. ``derivative_times.py`` times warpmpc's own differences.
"""

from __future__ import annotations

import argparse
import time

import newton
import numpy as np
import warp as wp
from crocoddyl_reach import scene as reach

from warpmpc import Scene, load_scene
from warpmpc.model.builder import build_world
from warpmpc.model.importers import new_builder

SOLVERS = {"featherstone": newton.solvers.SolverFeatherstone, "semi_implicit": newton.solvers.SolverSemiImplicit}
TASKS = {"arm": (64, 0.02), "cartpole_swingup": (75, 0.01)}
"""Worlds, one for each step of a horizon, and length of the step [s]."""
STEP = 1e-3
"""Of the differences: numbers near 1 are 1e-7 apart in single precision."""


class Steps:
    """Worlds that take one step, each from a start (q, qd, torque) of its own, all joints with one coordinate.

    Args:
        scene: What is in a world.
        worlds: How many there are.
        solver: Name of the solver.
        dt: Length of the step [s].
    """

    def __init__(self, scene: Scene, worlds: int, solver: str, dt: float):
        builder = new_builder()
        builder.replicate(build_world(scene).builder, worlds)
        self.model = model = builder.finalize(device="cpu", requires_grad=True)
        self.solver, self.dt, self.worlds = SOLVERS[solver](model), dt, worlds
        self.maximal = solver == "semi_implicit"
        self.before, self.after, self.control = model.state(), model.state(), model.control()
        self.control.joint_f = wp.zeros_like(model.joint_qd, requires_grad=True)
        self.given = [self.before.joint_q, self.before.joint_qd, self.control.joint_f]
        self.found = [self.after.joint_q, self.after.joint_qd]

    def __call__(self, start: np.ndarray) -> np.ndarray:
        """Ends (q, qd) ``[W, 2n]`` of starts ``[W, 3n]``."""
        for array, values in zip(self.given, np.split(start, 3, axis=1), strict=True):
            array.assign(np.ascontiguousarray(values.ravel(), dtype=np.float32))
        self.before.clear_forces()
        newton.eval_fk(self.model, self.before.joint_q, self.before.joint_qd, self.before)
        self.solver.step(self.before, self.after, self.control, None, self.dt)
        if self.maximal:
            newton.eval_ik(self.model, self.after, self.after.joint_q, self.after.joint_qd)
        return np.hstack([array.numpy().reshape(self.worlds, -1) for array in self.found]).astype(float)

    def tape(self, start: np.ndarray) -> np.ndarray:
        """Derivatives of the ends by Warp's tape ``[W, 2n, 3n]``."""
        with wp.Tape() as tape:
            self(start)
        rows = []
        for array in self.found:
            n = array.size // self.worlds
            for i in range(n):
                seed = np.zeros((self.worlds, n), dtype=np.float32)
                seed[:, i] = 1.0
                tape.zero()
                tape.backward(grads={array: wp.array(seed.ravel(), dtype=float, device="cpu")})
                rows.append(np.hstack([given.grad.numpy().reshape(self.worlds, -1) for given in self.given]))
        tape.zero()
        return np.stack(rows, axis=1)


def differences(steps: Steps, start: np.ndarray) -> np.ndarray:
    """Derivatives of the ends by centred differences ``[W, 2n, 3n]``, in worlds that hold all moved starts."""
    moves = STEP * np.eye(start.shape[1])
    moved = np.stack([start[:, None] + moves, start[:, None] - moves])  # [2, W, 3n, 3n]
    forth, back = steps(moved.reshape(-1, start.shape[1])).reshape(*moved.shape[:3], -1)
    return ((forth - back) / (2.0 * STEP)).swapaxes(1, 2)


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=5)
    args = parser.parse_args()
    print("| model, worlds | solver | the tape | largest entry | apart |\n|---|---|---|---|---|")
    for name, (worlds, dt) in TASKS.items():
        scene = reach("newton") if name == "arm" else load_scene(name)
        for solver in SOLVERS:
            single, rng = Steps(scene, worlds, solver, dt), np.random.default_rng(0)
            home = single.model.joint_q.numpy().reshape(worlds, -1)
            noise = rng.standard_normal((3, *home.shape)) * np.array([0.1, 0.3, 1.0])[:, None, None]
            start = np.hstack([home + noise[0], *noise[1:]])
            taken = []
            for _ in range(args.times + 1):
                began = time.perf_counter()
                found = single.tape(start)
                taken.append(1e3 * (time.perf_counter() - began))
            wanted = differences(Steps(scene, 2 * worlds * start.shape[1], solver, dt), start)
            apart, largest = np.abs(found - wanted).max(), np.abs(wanted).max()
            print(f"| `{name}`, {worlds} | {solver} | {np.median(taken[1:]):.0f} ms | {largest:.2g} | {apart:.2g} |")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
