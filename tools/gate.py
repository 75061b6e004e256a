#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Whether a change moves any command: record what the planner sends in every shipped scene, compare bit for bit.

    python tools/gate.py record before.npz         # on the old code
    python tools/gate.py compare before.npz        # on the new code, same machine

Every case is a closed loop of a few plans on the CPU from a fixed seed: the shipped scenes with some of
their variants, and settings of the planner that no shipped scene has. Commands depend on the processor, so a record
holds for the machine it was made on.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

PLANS = 12
SEEDS = (0, 1)
VARIANTS = {
    "omni_push_box": ("B", "kicked", "shoved", "noisy"),
    "omni_push_sphere": ("B",),
    "panda_push": ("pose_2",),
    "panda_push_objects": ("E_left",),
    "mobile_pick": ("knocked",),
    "panda_reach": ("meshes",),
}
SMALL = {"panda_push_objects": ("planner.samples=64",)}
"""Overrides of scenes that take too long as they are."""
SETTINGS = (
    ("planner.method=cem", "planner.iterations=2", "planner.elites=6"),
    ("planner.method=predictive_sampling", "planner.noise.redraw=true"),
    ("planner.samples=16", "planner.domains=4", "planner.risk=cvar"),
    ("planner.samples=16", "planner.domains=2", "planner.risk=worst"),
    ("planner.spline=linear", "planner.noise.source=sobol"),
    ("planner.spline=bspline", "planner.noise.shape=coloured"),
    ("planner.temperature.eta=false", "planner.temperature.ess=8", "planner.noise.source=random"),
    ("planner.noise.shape=comb", "planner.noise.null_sample=false"),
    ("planner.knots=false", "planner.spline=zero", "planner.dt=0.04", "planner.noise.shape=bspline"),
    ("planner.randomize=false", "planner.step_size=0.5", "engine.threads=1"),
)


def cases() -> Iterator[tuple[str, tuple[str, ...], int]]:
    """Scene, overrides and seed of every case."""
    import warpmpc

    for name in sorted(warpmpc.shipped_scenes()):
        for variant in ("", *VARIANTS.get(name, ())):
            for seed in SEEDS:
                yield name + (f":{variant}" if variant else ""), SMALL.get(name, ()), seed
    for overrides in SETTINGS:
        yield "omni_push_box", overrides, 0
        yield "point_reach", overrides, 0


def label(case: tuple[str, tuple[str, ...], int]) -> str:
    """What a case is called in a record."""
    name, overrides, seed = case
    return " ".join((name, *overrides, f"seed={seed}"))


def play(case: tuple[str, tuple[str, ...], int]) -> np.ndarray:
    """The commands ``[plans, nu]`` of one case, with the plant's time appended."""
    import warp as wp

    import warpmpc
    from warpmpc.run.episode import Episode

    wp.config.log_level = wp.LOG_ERROR
    name, overrides, seed = case
    episode = Episode(warpmpc.load_scene(name, overrides=overrides), seed=seed, device="cpu")
    rows = []
    for _ in range(PLANS):
        command = episode.controller.step(episode.plant.observe())
        episode.plant.apply(command)
        rows.append([*command, *episode.plant.state.joint_q])
    return np.array(rows, dtype=np.float32)


def main() -> int:
    """Command line of this tool."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["record", "compare"])
    parser.add_argument("file", type=Path)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", default="", help="cases whose label contains this")
    args = parser.parse_args()
    chosen = [case for case in cases() if args.only in label(case)]
    with ProcessPoolExecutor(args.jobs) as pool:
        found = dict(zip(map(label, chosen), pool.map(play, chosen), strict=True))
    if args.what == "record":
        np.savez(args.file, **found)
        print(f"{len(found)} cases recorded")
        return 0
    moved = 0
    with np.load(args.file) as before:
        for name, rows in found.items():
            if name not in before:
                print(f"new      {name}")
            elif not np.array_equal(rows, before[name], equal_nan=True):
                moved += 1
                first = int(np.flatnonzero((rows != before[name]).any(axis=1))[0])
                print(f"MOVED    {name}: from plan {first}, by {np.nanmax(np.abs(rows - before[name])):.3g}")
    print(f"{len(found) - moved} of {len(found)} cases bit-identical")
    return 1 if moved else 0


if __name__ == "__main__":
    sys.exit(main())
