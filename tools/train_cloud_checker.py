#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Train checkers of links against point clouds, and compare them with geometry in error and time.

    python tools/train_cloud_checker.py storm_reach --links panda_link3 panda_link5 panda_link6 panda_hand

The paper's checker (Bhardwaj et al., STORM, CoRL 2021) takes a cloud and a link's pose and says whether they collide.
This one looks at distances from the cloud, or at which cells it fills, at points that move with the link; a small
network for each link says the rest. It learns from clutter on a table, seen by a noisy depth camera from one side;
what is right is told by the things themselves, which the cloud shows half of. Geometry knows the cloud alone.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from learned.clutter import Clutter, Volume, drawn_poses
from learned.network import Network, train

from warpmpc import SceneError, load_scene
from warpmpc.model.compiled import compile_scene
from warpmpc.model.hulls import SPACING, Hull, shape_hull, thinned
from warpmpc.model.spheres import fit_spheres

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from warpmpc.model.layout import Layout

POINTS = 96
"""Points within a link and around it that its network looks at."""
CELL = 0.025
"""Of the volume [m]."""
HIDDEN = (64, 32)
FEATURES = ("distance", "occupancy")
ALIKE = (0.1, 0.05)
"""Shares of the collisions that every checker may miss where they are compared at equal terms."""
REACH = 0.15
"""Distances beyond this look alike to a network [m]."""


@dataclass(frozen=True)
class Link:
    """One link, as the checkers see it, in its own frame."""

    name: str
    hulls: list[Hull]
    surface: np.ndarray  # [p, 3] what decides about the truth
    probes: np.ndarray  # [at most POINTS, 3] where its network looks
    spheres: dict[float, tuple[np.ndarray, np.ndarray]]
    """Centres ``[s, 3]`` and radii ``[s]`` by how far they may stick out."""

    @classmethod
    def of(cls, layout: Layout, name: str, overhangs: Sequence[float]) -> Link:
        """A link of a layout by its name, ``robot/link`` or the link's own.

        Raises:
            SceneError: If there is no such link with shapes.
        """
        bodies = {full.partition("/")[2]: body for body, full in enumerate(layout.body_name)}
        shapes = [s for s in layout.shapes if s.body == bodies.get(name) and s.collides]
        if not shapes:
            raise SceneError("no such link, or none with shapes", key="links", found=name, allowed=bodies)
        hulls = [shape_hull(layout, shape, SPACING) for shape in shapes]
        surface = np.concatenate([hull.surface for hull in hulls])
        middle = surface.mean(axis=0)
        layers = [middle + share * (surface - middle) for share in (0.5, 1.0, 1.7)]
        probes = np.concatenate([thinned(layer, count=POINTS // 3) for layer in layers])
        spheres = {}
        for overhang in overhangs:
            found = fit_spheres(layout, [bodies[name]], overhang=overhang, most=24)
            spheres[overhang] = found.centre, found.radius
        return cls(name, hulls, thinned(surface, count=600), probes, spheres)

    def depth(self, points: np.ndarray) -> np.ndarray:
        """How far points ``[p, 3]`` are inside the link, negative outside [m]."""
        return np.max([hull.depth(points) for hull in self.hulls], axis=0)


@dataclass(frozen=True)
class Poses:
    """Poses of one link in one clutter."""

    at: np.ndarray  # [n, 3]
    turn: np.ndarray  # [n, 3, 3]

    def world(self, points: np.ndarray) -> np.ndarray:
        """Where points of the link are ``[n, p, 3]``."""
        return self.at[:, None] + np.einsum("nij,pj->npi", self.turn, points)


def truly(clutter: Clutter, link: Link, poses: Poses) -> np.ndarray:
    """Whether the link and a thing share a point ``[n]``."""
    near = clutter.distance(poses.at) < np.linalg.norm(link.surface, axis=1).max()
    hit = np.zeros(len(poses.at), dtype=bool)
    points = Poses(poses.at[near], poses.turn[near]).world(link.surface)
    hit[near] = clutter.distance(points.reshape(-1, 3)).reshape(points.shape[:2]).min(axis=1) < 0.0
    return hit


def by_spheres(volume: Volume, link: Link, poses: Poses, overhang: float) -> np.ndarray:
    """Clearance of the link's spheres in the volume ``[n]`` [m]."""
    centre, radius = link.spheres[overhang]
    return (volume.at(poses.world(centre)) - radius).min(axis=1)


def by_points(cloud: np.ndarray, link: Link, poses: Poses) -> np.ndarray:
    """How far the cloud stays outside the link's hulls ``[n]`` [m]."""
    reach = np.linalg.norm(link.surface, axis=1).max()
    out = np.full(len(poses.at), reach)
    for i, (at, turn) in enumerate(zip(poses.at, poses.turn, strict=True)):
        near = cloud[((cloud - at) ** 2).sum(axis=1) < reach * reach]
        if len(near):
            out[i] = -link.depth((near - at) @ turn).max()
    return out


def features(volume: Volume, link: Link, poses: Poses, kind: str) -> np.ndarray:
    """What a network sees ``[n, probes]``."""
    near = volume.at(poses.world(link.probes))
    return np.minimum(near, REACH) if kind == "distance" else (near < 0.5 * volume.cell).astype(np.float32)


@dataclass(frozen=True)
class Judged:
    """Clearances that a checker found, the truth, and what it took."""

    clearance: np.ndarray
    """Below zero: collision."""
    hit: np.ndarray
    seconds: float
    """CPU time of one pose."""

    def errors(self, threshold: float = 0.0) -> tuple[float, float]:
        """Share of the collisions called free, and of the free poses called collisions."""
        free = self.clearance >= threshold
        return float(free[self.hit].mean()), float((~free[~self.hit]).mean())

    def at_equal_terms(self, missed: float) -> float:
        """Share of the free poses called collisions at the threshold that misses this share of the collisions."""
        return self.errors(float(np.quantile(self.clearance[self.hit], 1.0 - missed)))[1]


def scenes(links: Sequence[Link], count: int, poses: int, seed: int) -> list[list[tuple]]:
    """Draw clutters with poses of all links.

    Returns:
        For each clutter and link: cloud, volume, poses, and which collide.
    """
    out = []
    for i in range(count):
        rng = np.random.default_rng([seed, i])
        clutter = Clutter.drawn(rng)
        cloud = clutter.seen(rng)
        volume = Volume.of(cloud, CELL)
        drawn = [Poses(*drawn_poses(poses, rng)) for _ in links]
        own = zip(links, drawn, strict=True)
        out.append([(cloud, volume, p, truly(clutter, link, p)) for link, p in own])
    return out


def trained(link: Link, data: list[tuple], kind: str, steps: int, rng: np.random.Generator) -> Network:
    """A network that says how sure it is of a collision, as a logit, of raw features."""
    x = np.concatenate([features(volume, link, poses, kind) for _, volume, poses, _ in data])
    hit = np.concatenate([hit for *_, hit in data]).astype(np.float32)
    mean, deviation = x.mean(axis=0), np.maximum(x.std(axis=0), 1e-2)
    x = ((x - mean) / deviation).astype(np.float32)
    network = Network.drawn((x.shape[1], *HIDDEN, 1), rng)

    def draw(batch: int) -> tuple[np.ndarray, np.ndarray]:
        rows = rng.integers(len(x), size=batch)
        return x[rows], hit[rows]

    train(network, draw, lambda out, wanted: 1.0 / (1.0 + np.exp(-out)) - wanted, steps=steps, batch=512)
    return network.normalized(mean, deviation, 1.0)


def judged(check: Callable[[tuple, Link], np.ndarray], data: list[list[tuple]], links: Sequence[Link]) -> Judged:
    """Ask a checker about all poses, and take its time."""
    start, found, hits = time.process_time(), [], []
    for rows in data:
        for row, link in zip(rows, links, strict=True):
            found.append(check(row, link))
            hits.append(row[3])
    seconds = time.process_time() - start
    clearance = np.concatenate(found)
    return Judged(clearance, np.concatenate(hits), seconds / len(clearance))


def compare(
    links: Sequence[Link], train_data: list, test_data: list, overhangs: Sequence[float], steps: int, seed: int
) -> dict[str, Judged]:
    """Every checker on the same held-out poses."""
    out = {}
    for overhang in overhangs:
        name = f"volume, spheres that stick out {1e3 * overhang:.0f} mm"
        out[name] = judged(
            lambda row, link, o=overhang: by_spheres(row[1], link, row[2], o),
            test_data,
            links,
        )
    out["cloud in the hulls"] = judged(lambda row, link: by_points(row[0], link, row[2]), test_data, links)
    for kind in FEATURES:
        rng = np.random.default_rng([seed, 7])
        networks = {
            link.name: trained(link, [rows[i] for rows in train_data], kind, steps, rng) for i, link in enumerate(links)
        }
        out[f"learned, {kind}"] = judged(
            lambda row, link, n=networks, k=kind: -n[link.name](features(row[1], link, row[2], k)),
            test_data,
            links,
        )
    return out


def main() -> None:
    """Train, compare, print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene")
    parser.add_argument("--links", nargs="+", required=True)
    parser.add_argument("--clutters", type=int, default=300, help="to train on")
    parser.add_argument("--held-out", type=int, default=60, help="clutters that tell the error")
    parser.add_argument("--poses", type=int, default=250, help="of each link in each clutter")
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--overhangs", type=float, nargs="+", default=[0.03, 0.01])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    start = time.process_time()
    try:
        layout = compile_scene(load_scene(options.scene)).layout
        links = [Link.of(layout, name, options.overhangs) for name in options.links]
    except SceneError as error:
        parser.error(str(error))
    counts = (("train", options.clutters), ("test", options.held_out))
    data = [scenes(links, n, options.poses, options.seed + i) for i, (_, n) in enumerate(counts)]
    drawn = time.process_time() - start
    found = compare(links, *data, options.overhangs, options.steps, options.seed)
    hit = next(iter(found.values())).hit
    print(f"{drawn:.0f} s of CPU time to draw, {time.process_time() - start:.0f} s in all; {hit.mean():.1%} collide")
    rows = {}
    for name, checker in found.items():
        missed, wrong = checker.errors()
        alike = {f"{share:.0%} missed": checker.at_equal_terms(share) for share in ALIKE}
        rows[name] = {"missed": missed, "false": wrong, **alike, "us": 1e6 * checker.seconds}
        text = ", ".join(f"{wrong:6.2%} at {key}" for key, wrong in alike.items())
        print(f"{name:38s} {missed:6.2%} missed, {wrong:6.2%} false ({text}), {1e6 * checker.seconds:6.1f} µs a pose")
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
