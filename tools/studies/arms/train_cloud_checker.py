# SPDX-License-Identifier: Apache-2.0
"""Train the networks of the cost term ``learned_cloud_collision``: whether a link at a pose touches what a cloud shows.

    python tools/study.py train_cloud_checker storm_cloud --out panda_cloud_checker.npz

The binary checker of Bhardwaj et al., STORM, CoRL 2021, for a scene with a cloud and a camera. The scene's obstacles
are drawn anew for every picture. A network for each link looks at the volume's distances at points that move with the
link. Obstacles themselves say what is right; the cloud shows the sides that the camera sees. Held-out draws tell the
error, beside that of the spheres of ``cloud_collision``.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from studies.arms.learned.clutter import Clutter
from studies.arms.learned.network import Network, train
from warpmpc import SceneError, load_scene
from warpmpc.scene.model.compiled import compile_scene
from warpmpc.scene.model.hulls import SPACING, shape_hull, thinned
from warpmpc.scene.model.spheres import fit_spheres, link_fingerprint

if TYPE_CHECKING:
    from collections.abc import Sequence

    from studies.arms.learned.clutter import SeenVolume
    from warpmpc import Scene
    from warpmpc.scene.model.layout import Layout

POINTS = 96
"""Points within a link and around it that its network looks at."""
HIDDEN = (64, 32)
REACH = 0.15
"""Distances beyond this look alike to a network [m]."""
LINKS = ("panda_link3", "panda_link4", "panda_link5", "panda_link6", "panda_link7", "panda_hand")
LINKS += ("panda_leftfinger", "panda_rightfinger")
OVERHANG = 0.015
"""Length by which the spheres that are compared may stick out of the links [m]."""


@dataclass(frozen=True)
class Link:
    """One link in its own frame."""

    name: str
    fingerprint: str
    surface: np.ndarray
    """Points that decide about the truth ``[p, 3]`` [m]."""
    probes: np.ndarray
    """Points at which its network looks ``[POINTS, 3]`` [m]."""
    bound: np.ndarray
    """Centre of a sphere around it, and its radius ``[4]`` [m]."""
    spheres: tuple[np.ndarray, np.ndarray]
    """Centres ``[s, 3]`` and radii ``[s]`` of ``cloud_collision`` [m]."""

    @classmethod
    def of(cls, layout: Layout, name: str) -> Link:
        """A link of a layout by its own name.

        Raises:
            SceneError: If there is no such link with shapes.
        """
        bodies = {full.partition("/")[2]: body for body, full in enumerate(layout.body_name)}
        shapes = [s for s in layout.shapes if s.collides and s.body == bodies.get(name, -2)]
        if not shapes:
            raise SceneError("no such link, or none with shapes", key="links", found=name, allowed=bodies)
        surface = np.concatenate([shape_hull(layout, shape, SPACING).surface for shape in shapes])
        middle = surface.mean(axis=0)
        layers = [thinned(middle + share * (surface - middle), count=POINTS // 3) for share in (0.5, 1.0, 1.7)]
        radius = np.linalg.norm(surface - middle, axis=1).max()
        found = fit_spheres(layout, [bodies[name]], overhang=OVERHANG)
        probes = np.concatenate(layers)
        probes = np.concatenate([probes, np.repeat(middle[None], POINTS - len(probes), axis=0)])
        spheres = found.centre, found.radius
        fingerprint = link_fingerprint(layout, bodies[name])
        return cls(name, fingerprint, thinned(surface, count=250), probes, np.append(middle, radius), spheres)


@dataclass(frozen=True)
class Poses:
    """Poses of one link in one clutter: what its network sees, and what is true."""

    features: np.ndarray
    """``[n, POINTS]`` [m]"""
    near: np.ndarray
    """True where the sphere around the link is near anything ``[n]``; nothing is asked elsewhere."""
    hit: np.ndarray
    """True where the link touches an obstacle ``[n]``."""
    by_spheres: np.ndarray
    """True where ``cloud_collision`` says so ``[n]``."""

    @classmethod
    def drawn(cls, link: Link, clutter: Clutter, volume: SeenVolume, count: int, rng: np.random.Generator) -> Poses:
        """Poses among the obstacles."""
        places = np.array([obstacle.position for obstacle in clutter.obstacles])
        low, high = places.min(axis=0) - [0.25, 0.1, 0.0], places.max(axis=0) + [0.05, 0.1, 0.15]
        at, turn = rng.uniform(low, high, (count, 3)), Rotation.random(count, random_state=rng).as_matrix()

        def world(points: np.ndarray) -> np.ndarray:
            return at[:, None] + np.einsum("nij,pj->npi", turn, points)

        middle = world(link.bound[None, :3])
        some = clutter.distance(middle[:, 0]) < link.bound[3]
        surface, hit = world(link.surface)[some], np.zeros(count, dtype=bool)
        hit[some] = clutter.distance(surface.reshape(-1, 3)).reshape(surface.shape[:2]).min(axis=1) < 0.0
        features = np.minimum(volume.at(world(link.probes)), REACH).astype(np.float32)
        apart = volume.at(middle)[:, 0]
        near = apart < near_distance(link.bound[3], volume.voxel)
        centre, radius = link.spheres
        clearance = (volume.at(world(centre)) - radius).min(axis=1) - 0.5 * 3.0**0.5 * volume.voxel
        return cls(features, near, hit, clearance < 0.0)


def near_distance(radius: float, voxel: float) -> float:
    """Distance of the voxel at a link's middle from the cloud below which its network is asked [m]."""
    return radius + 3.0**0.5 * voxel


def gathered(link: Link, scene: Scene, seeds: Sequence[int], poses: int, views: dict) -> Poses:
    """Poses in all clutters of these seeds."""
    found = []
    for seed in seeds:
        if seed not in views:
            clutter = Clutter.drawn(scene, seed)
            views[seed] = clutter, clutter.volume()
        rng = np.random.default_rng([seed, *link.name.encode()])
        found.append(Poses.drawn(link, *views[seed], poses, rng))
    return Poses(*(np.concatenate([getattr(p, name) for p in found]) for name in vars(found[0])))


def trained(data: Poses, steps: int, rng: np.random.Generator) -> Network:
    """A network whose output is the logit of a collision, of raw features and in half precision."""
    x, hit = data.features[data.near], data.hit[data.near].astype(np.float32)
    mean, deviation = x.mean(axis=0), np.maximum(x.std(axis=0), 1e-2)
    x = ((x - mean) / deviation).astype(np.float32)
    network = Network.drawn((POINTS, *HIDDEN, 1), rng)

    def draw(batch: int) -> tuple[np.ndarray, np.ndarray]:
        rows = rng.integers(len(x), size=batch)
        return x[rows], hit[rows]

    train(network, draw, lambda out, wanted: 1.0 / (1.0 + np.exp(-out)) - wanted, steps=steps, batch=512)
    network = network.normalized(mean, deviation, 1.0)
    for values in (network.weights, network.biases):
        values[:] = [v.astype(np.float16).astype(np.float32) for v in values]
    return network


def errors(said: np.ndarray, hit: np.ndarray) -> tuple[float, float]:
    """Share of the collisions called free, and of the free poses called collisions."""
    return float((~said[hit]).mean()), float(said[~hit].mean())


def main(arguments: list[str]) -> None:
    """Train networks, print their errors and write them down."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--links", nargs="+", default=LINKS)
    parser.add_argument("--clutters", type=int, default=100, help="to train on (default 100)")
    parser.add_argument("--held-out", type=int, default=30, help="clutters that tell the error (default 30)")
    parser.add_argument("--poses", type=int, default=160, help="of each link in each clutter (default 160)")
    parser.add_argument("--steps", type=int, default=4000, help="of the training (default 4000)")
    parser.add_argument("--seed", type=int, default=100_000, help="first clutter; runs of a scene count from 0")
    options = parser.parse_args(arguments)
    start = time.process_time()
    first, views = options.seed, {}
    seeds = (
        range(first, first + options.clutters),
        range(first + options.clutters, first + options.clutters + options.held_out),
    )
    try:
        scene = load_scene(options.scene)
        layout = compile_scene(scene).layout
        links = [Link.of(layout, name) for name in options.links]
        voxel = Clutter.drawn(scene, first).cloud.voxel
    except SceneError as error:
        parser.error(str(error))
    networks, said, spheres, hits, took = [], [], [], [], 0.0
    for link in links:
        data, test = (gathered(link, scene, some, options.poses, views) for some in seeds)
        networks.append(trained(data, options.steps, np.random.default_rng([options.seed, 7])))
        asked = time.process_time()
        said.append((networks[-1](test.features) > 0.0) & test.near)
        took += time.process_time() - asked
        spheres.append(test.by_spheres)
        hits.append(test.hit)
        print(_line(link.name, said[-1], spheres[-1], test.hit), flush=True)
    told = [np.concatenate(rows) for rows in (said, spheres, hits)]
    print(_line("all links", *told))
    layers = {
        f"{kind}{n + 1}": np.stack([getattr(net, name)[n] for net in networks]).astype(np.float16)
        for kind, name in (("w", "weights"), ("b", "biases"))
        for n in range(3)
    }
    found = dict(zip(("missed", "false"), errors(told[0], told[2]), strict=True))
    np.savez_compressed(
        options.out,
        links=np.array([link.name for link in links]),
        trained_for=np.array([link.fingerprint for link in links]),
        voxel=voxel,
        reach=REACH,
        probes=np.stack([link.probes for link in links]).astype(np.float32),
        middle=np.stack([link.bound[:3] for link in links]).astype(np.float32),
        near=np.array([near_distance(link.bound[3], voxel) for link in links], dtype=np.float32),
        errors=json.dumps(found),
        **layers,
    )
    size, spent = options.out.stat().st_size / 1024, time.process_time() - start
    poses = f"{len(told[2])} held-out poses, {1e6 * took / len(told[2]):.1f} µs each for the network in NumPy"
    print(f"{options.out}: {size:.0f} KB; {poses}; {spent:.0f} s of CPU time in all")


def _line(name: str, said: np.ndarray, spheres: np.ndarray, hit: np.ndarray) -> str:
    (missed, wrong), (near, far) = errors(said, hit), errors(spheres, hit)
    learned = f"learned {missed:6.2%} missed, {wrong:6.2%} false"
    return f"{name:18s} {hit.mean():5.1%} collide; {learned}; spheres {near:6.2%} missed, {far:6.2%} false"
