#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
r"""What feedback gains are worth between slow plans: a pole is held up by iLQG while its plant is pushed.

    python tools/gains.py --rates 10 5 2 --push 0.4 --runs 10

The pole of `cartpole_swingup` starts near the top; it is commanded 500 times a second from plans that are made less
often, on the plant's clock, and pushed once a second: a sudden change of its angular velocity of --push, to one side or
the other. A run is won if the pole is within 25 degrees of the top during the last half second. Prints how many are,
with the gains of the plans and without.
"""

from __future__ import annotations

import argparse

import numpy as np

from warpmpc import Controller, Plant, Scene, load_scene
from warpmpc.scene.load import with_values

SECONDS, TICK = 7.0, 0.002
ITERATIONS = 10
"""Of each plan: slow plans have the time for it."""
COST = [
    {"term": "position_residual", "of": "cart/tip", "target": [0.0, 1.0], "axes": "xz", "weight": 10.0},
    {"term": "joint_velocity", "weight": 0.05},
    {"term": "control_effort", "weight": 0.05},
]
UPRIGHT = np.cos(np.deg2rad(25.0))


def scene(push: float, seed: int) -> Scene:
    """The pole, with a push a second."""
    rng = np.random.default_rng(seed)
    kicks = [
        {"time": t + float(rng.uniform(0.0, 0.5)), "target": "cart", "velocity": [0.0, float(side) * push]}
        for t, side in zip(np.arange(0.5, SECONDS - 1.0), rng.choice([-1.0, 1.0], 10), strict=False)
    ]
    changed = {
        "planner.method": "ilqg",
        "planner.refine": {"method": "ilqg", "iterations": ITERATIONS},
        "planner.horizon": 60,
        "planner.dt": [0.02],
        "planner.spline": "linear",
        "engine.threads": 1,
        "engine.substeps": 2,
        "plant.substeps": 1,
        "plant.kicks": kicks,
        "timing.control_dt": TICK,
        "cost": COST,
        "robot.cart.joint_q": [0.0, float(rng.uniform(-0.1, 0.1))],
    }
    return with_values(load_scene("cartpole_swingup"), changed)


def held(push: float, rate: float, seed: int, *, gains: bool) -> bool:
    """Whether the pole stands in the end.

    Args:
        push: Change of its angular velocity [rad/s].
        rate: Plans a second.
        seed: Seed of pushes and start.
        gains: Whether commands answer what is observed.
    """
    pole = scene(push, seed)
    controller, plant = Controller(pole, device="cpu", seed=seed), Plant(pole, seed=seed)
    every, heights = round(1.0 / rate / TICK), []
    for tick in range(round(SECONDS / TICK)):
        state = plant.observe()
        if tick % every == 0:
            plan = controller.plan(state)
        plant.apply(plan.at(state.time, state if gains else None))
        if state.time > SECONDS - 0.5:
            heights.append(np.cos(state.joint_q[1]))
    return bool(min(heights) > UPRIGHT)


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rates", type=float, nargs="+", default=[10.0, 5.0, 2.0], help="plans a second")
    parser.add_argument("--push", type=float, default=0.4, help="[rad/s]")
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    print("| plans a second | with gains | without |\n|---|---|---|")
    for rate in args.rates:
        seeds = range(args.seed, args.seed + args.runs)
        won = [sum(held(args.push, rate, seed, gains=gains) for seed in seeds) for gains in (True, False)]
        print(f"| {rate:g} | {won[0]} of {args.runs} | {won[1]} of {args.runs} |", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
