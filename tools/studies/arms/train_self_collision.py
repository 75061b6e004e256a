# SPDX-License-Identifier: Apache-2.0
"""Train the network of the cost term ``learned_self_collision`` on the geometric distance.

    python tools/study.py train_self_collision storm_reach --out panda_self_collision.npz
    python tools/study.py train_self_collision my_scene.toml --robot arm --hidden 64 64 --steps 5000 --out arm.npz

The network is that of Bhardwaj et al., STORM, CoRL 2021: sin q and cos q of every joint → 256 → 64 → 1 with ReLU6.
Configurations are drawn within the joints' limits; what it learns is how deep the spheres of two links are in each
other, negative where all are apart. A held-out draw tells how well it did.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from studies.arms.learned.network import Network, train
from studies.arms.learned.self_distance import SelfDistance
from warpmpc import SceneError, load_scene

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

NEAR = 0.02
"""Distances from the boundary whose error is told apart [m]."""


@dataclass(frozen=True)
class Errors:
    """How far a network is from the geometry, on configurations that it has not seen [m]."""

    mean: float
    p95: float
    near: float
    """Mean of those whose true distance from the boundary is below :data:`NEAR`."""
    near_p95: float
    colliding: float
    """Share of configurations in collision."""
    false_free: float
    """Share of those in collision that the network calls free."""
    false_collision: float
    """Share of the free ones that the network says collide."""
    unseen: float
    """Greatest depth of a collision that the network calls free."""

    @classmethod
    def of(cls, found: np.ndarray, wanted: np.ndarray) -> Errors:
        """Compare distances ``[n]``."""
        off, hit = np.abs(found - wanted), wanted > 0.0
        near = off[np.abs(wanted) < NEAR]
        missed = hit & (found <= 0.0)
        return cls(
            mean=float(off.mean()),
            p95=float(np.quantile(off, 0.95)),
            near=float(near.mean()) if len(near) else 0.0,
            near_p95=float(np.quantile(near, 0.95)) if len(near) else 0.0,
            colliding=float(hit.mean()),
            false_free=float(missed.sum() / max(hit.sum(), 1)),
            false_collision=float((~hit & (found > 0.0)).sum() / max((~hit).sum(), 1)),
            unseen=float(wanted[missed].max(initial=0.0)),
        )

    def __str__(self) -> str:
        return (
            f"mean {1e3 * self.mean:.2f} mm, p95 {1e3 * self.p95:.2f} mm; within {1e3 * NEAR:.0f} mm of the boundary "
            f"{1e3 * self.near:.2f} mm, p95 {1e3 * self.near_p95:.2f} mm; {self.colliding:.1%} collide, of which "
            f"{self.false_free:.2%} are called free (up to {1e3 * self.unseen:.1f} mm deep); "
            f"{self.false_collision:.2%} of the free ones are called collisions"
        )


@dataclass(frozen=True)
class Trained:
    """A network with what it takes to write it down."""

    distance: SelfDistance
    network: Network
    errors: Errors

    def save(self, path: Path, *, half: bool = True) -> None:
        """Write the weights as the term reads them, in half precision unless said otherwise."""
        kind = np.float16 if half else np.float32
        layers = zip(self.network.weights, self.network.biases, strict=True)
        arrays = {}
        for n, (weight, bias) in enumerate(layers, start=1):
            arrays |= {f"w{n}": weight.astype(kind), f"b{n}": bias.astype(kind)}
        errors = json.dumps(vars(self.errors))
        names = np.array(self.distance.names)
        np.savez_compressed(path, joints=names, trained_for=self.distance.fingerprint, errors=errors, **arrays)


def slope(found: np.ndarray, wanted: np.ndarray, scale: float) -> np.ndarray:
    """Derivative of a loss that is quadratic within 5 mm and linear beyond, and heavier near the boundary."""
    weight = 0.2 + np.exp(-np.abs(wanted) * scale / 0.05)
    return (weight * np.clip((found - wanted) * scale / 5e-3, -1.0, 1.0)).astype(np.float32)


def trained(
    distance: SelfDistance,
    *,
    hidden: Sequence[int] = (256, 64),
    configurations: int = 1_000_000,
    steps: int = 20_000,
    batch: int = 2048,
    held_out: int = 100_000,
    seed: int = 0,
    half: bool = True,
    told: Callable[[str], None] = lambda text: None,
) -> Trained:
    """Train a network on a robot's geometry.

    Args:
        distance: What it learns.
        hidden: Units of the rows between input and output.
        configurations: How many are drawn to train on.
        steps: Steps of the training.
        batch: Configurations of a step.
        held_out: Configurations that tell the error.
        seed: Of all draws.
        half: Whether the weights will be written down in half precision; the error is that of what is written.
        told: Called with what is under way.
    """
    rng = np.random.default_rng(seed)
    q = distance.draw(configurations, rng)
    wanted, x = distance(q), distance.inputs(q)
    share = (wanted > 0.0).mean()
    told(f"{len(distance.pairs)} pairs of spheres; of {configurations} configurations {share:.1%} collide")
    mean, deviation = x.mean(axis=0), np.maximum(x.std(axis=0), 1e-3)
    x, scale = (x - mean) / deviation, float(wanted.std())
    wanted = wanted / scale
    network = Network.drawn((x.shape[1], *hidden, 1), rng)

    def draw(count: int) -> tuple[np.ndarray, np.ndarray]:
        rows = rng.integers(len(x), size=count)
        return x[rows], wanted[rows]

    def tell(step: int) -> None:
        if step % 1000 == 0:
            off = scale * np.abs(network(x[:20_000]) - wanted[:20_000])
            told(f"step {step} of {steps}: mean error {1e3 * off.mean():.2f} mm")

    train(network, draw, lambda a, b: slope(a, b, scale), steps=steps, batch=batch, told=tell)
    network = network.normalized(mean, deviation, scale)
    if half:
        for values in (network.weights, network.biases):
            values[:] = [v.astype(np.float16).astype(np.float32) for v in values]
    q = distance.draw(held_out, np.random.default_rng([seed, 1]))
    return Trained(distance, network, Errors.of(network(distance.inputs(q)), distance(q)))


def main(arguments: list[str]) -> None:
    """Train a network and write it down."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--robot")
    parser.add_argument("--joints", nargs="+", help="joints that may be anywhere; the driven ones when left out")
    parser.add_argument("--hidden", type=int, nargs=2, default=(256, 64))
    parser.add_argument("--configurations", type=int, default=1_000_000)
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--single", action="store_true", help="write single precision in place of half")
    options = parser.parse_args(arguments)
    start = time.process_time()
    try:
        distance = SelfDistance(load_scene(options.scene), options.robot, options.joints)
    except SceneError as error:
        parser.error(str(error))
    found = trained(
        distance,
        hidden=options.hidden,
        configurations=options.configurations,
        steps=options.steps,
        seed=options.seed,
        half=not options.single,
        told=lambda text: print(text, flush=True),
    )
    found.save(options.out, half=not options.single)
    size = options.out.stat().st_size / 1024
    print(f"{options.out}: {size:.0f} KB, {', '.join(distance.names)}; {time.process_time() - start:.0f} s of CPU time")
    print(found.errors)
