#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Draw the ways that four ways to sample lead to, as STORM's Fig. 3 does.

python tools/plot_sampling.py holonomic_2d --seed 1000 --out docs/holonomic_2d.png

Every panel has the path of one run, a mark on it every 30 controls, and the five best samples of the plan made there.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from measure import Meter

import warpmpc
from warpmpc.record.scene_picture import VIEWS, ScenePicture
from warpmpc.run.episode import Episode

EVERY = 30
"""Controls from one mark to the next."""
TOP = 5
"""Samples drawn at each."""


def panel(axes, name: str, seed: int, overrides: list[str]) -> None:
    """Run one episode and draw it."""
    episode = Episode(warpmpc.load_scene(name, overrides=overrides), seed=seed)
    meter = Meter(episode.plant)
    places, marks, samples = [meter.place], [], []

    def note(controller, plant, control) -> None:
        step = plant.steps - 1  # the plan was made at the state before
        if step % EVERY == 0:
            engine, body = controller.engine, controller.layout.frame_body[controller.layout.frame(target)]
            best = np.argsort(engine.cost.numpy()[0])[:TOP] * controller.shape.domains
            marks.append(meter.place)
            samples.append(engine.record(best.tolist()).body_q[:, :, body, :2])
        meter(controller, plant, control)
        places.append(meter.place)

    target = episode.plant.scene.goal.target
    ScenePicture(axes, episode.plant, VIEWS["top"]).outlines(episode.plant.body_q, ("obstacle",), alpha=0.5)
    result = episode.run(on_step=note)
    for rollouts in samples:
        axes.plot(rollouts[..., 0], rollouts[..., 1], color="tab:green", lw=0.6, alpha=0.7)
    places, marks = np.array(places), np.array(marks)
    axes.plot(places[:, 0], places[:, 1], color="tab:blue", lw=1.8)
    axes.plot(marks[:, 0], marks[:, 1], "o", color="tab:blue", ms=4)
    axes.plot(*episode.plant.goal[:2], marker="*", color="tab:red", ms=13, zorder=5)
    reached = f"{result.sim_time:.1f} s" if result.success else result.reason
    squares = f"∫‖p⃛‖² = {meter.squared_jerk:.0f}, ∫‖u̇‖² = {meter.squared_control_rate:.0f}"
    axes.set_xlabel(f"{reached}, {meter.path_length:.2f} m, {squares}")
    axes.set_aspect("equal")
    axes.autoscale_view()


def main() -> None:
    """Command line of this tool."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--out", type=Path, required=True, help="PNG file")
    args = parser.parse_args()

    figure, axes = plt.subplots(2, 2, figsize=(12, 9), dpi=90, sharex=True, sharey=True)
    for row, shape in enumerate(("comb", "bspline")):
        for column, source in enumerate(("random", "halton")):
            chosen = [*args.overrides, f"planner.noise.source={source}", f"planner.noise.shape={shape}"]
            panel(axes[row, column], args.scene, args.seed, chosen)
            axes[row, column].set_title(f"{source}, {shape}")
    args.out.parent.mkdir(parents=True, exist_ok=True)
    figure.tight_layout()
    figure.savefig(args.out)


if __name__ == "__main__":
    main()
