# SPDX-License-Identifier: Apache-2.0
"""Time the learned checker of links against a cloud: a pose of a link in the launch, and in NumPy.

    python tools/bench.py learned --rounds 20

Plans of ``storm_cloud:learned`` with and without the term's weight alternate in one process on one core, and so do
calls of the same networks in NumPy on as many poses; times are CPU times. A pose is one link in one step of one sample.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from scipy.spatial.transform import Rotation

LABEL = "learned_cloud_collision"


def main(arguments: list[str]) -> None:
    """Measure and tell."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=20, help="plans with and without it (default 20)")
    options = parser.parse_args(arguments)
    import warpmpc
    from warpmpc import Controller, Plant
    from warpmpc.cli.setup import start_warp
    from warpmpc.model.assets import resolve_asset
    from warpmpc.terms.learned_cloud import CheckerWeights

    start_warp()
    scene = warpmpc.load_scene("storm_cloud:learned", overrides=["engine.threads=1"])
    mpc = Controller(scene, device="cpu", seed=0)
    plant = Plant(scene, seed=0, task=mpc.task)
    weight = next(cost.weight for cost in scene.cost if cost.label == LABEL)
    path = resolve_asset(scene.cost[-1].params["weights"], base=scene.path.parent, key="weights")
    weights = CheckerWeights.load(path)
    links, rounds = len(weights.links), len(mpc.plan_step.strategy.population)
    poses = rounds * mpc.shape.samples * mpc.shape.horizon * links
    state = plant.observe()
    for value in (weight, 0.0, weight, 0.0):
        mpc.task[LABEL] = value
        mpc.step(state)
    rng = np.random.default_rng(0)
    at, turn = rng.uniform([0.3, -0.4, 0.0], [0.8, 0.4, 0.6], (250, 3)), Rotation.random(250, random_state=rng)
    (clouds,) = (resource for resource in mpc.costs.resources if hasattr(resource, "volumes"))
    volume = clouds.volumes["seen"].distance[0]
    times: dict[str, list[float]] = {"with": [], "without": [], "numpy": []}
    for i in range(options.rounds):
        for name, value in (("with", weight), ("without", 0.0)):
            mpc.task[LABEL] = value
            times[name].append(_cpu(lambda: mpc.step(state)))
        link = i % links
        times["numpy"].append(_cpu(lambda j=link: _numpy(weights, j, at, turn.as_matrix(), volume, scene.cloud[0].low)))
    near = mpc.costs.terms[-1][1].near
    near.fill_(1e6)  # every network is asked, however far its link is
    mpc.task[LABEL] = weight
    times["all"] = [_cpu(lambda: mpc.step(state)) for _ in range(options.rounds)]
    every = 1e6 * (np.median(times["all"]) - np.median(times["without"])) / poses
    spent = 1e6 * np.median(np.subtract(times["with"], times["without"])) / poses
    told = 1e6 * np.median(times["numpy"]) / len(at)
    plan = 1e3 * np.median(times["with"]), 1e3 * np.median(times["without"])
    print(f"{poses} poses a plan, {plan[0]:.2f} ms of CPU time a plan, {plan[1]:.2f} ms without the term")
    print(f"{spent:.3f} µs a pose in the launch, {told:.1f} µs in NumPy: {told / spent:.0f} times")
    print(f"{every:.3f} µs where the networks of links far from the cloud are asked, too: {told / every:.0f} times")


def _cpu(call) -> float:
    """CPU time of a call [s]."""
    start = time.process_time()
    call()
    return time.process_time() - start


def _numpy(weights, link: int, at: np.ndarray, turn: np.ndarray, volume: np.ndarray, low: tuple) -> np.ndarray:
    """Log-odds of a link at poses ``[n]``."""
    world = at[:, None] + np.einsum("nij,pj->npi", turn, weights.probes[link])
    top = np.array(volume.shape[::-1]) - 1e-3
    x, y, z = np.moveaxis(np.clip((world - low) / weights.voxel, 0.0, top).astype(int), -1, 0)
    value = np.minimum(volume[z, y, x], weights.reach)
    for w, b in zip(weights.weights[:2], weights.biases[:2], strict=True):
        value = np.clip(value @ w[link] + b[link], 0.0, 6.0)
    return (value @ weights.weights[2][link] + weights.biases[2][link])[:, 0]
