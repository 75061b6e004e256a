#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Draw one closed-loop run: where everything went, and with --curves what it cost.

    python tools/plot_run.py omni_push_box --out docs/omni_push_box.png
    python tools/plot_run.py panda_reach --view 3d --curves --out reach.png
    python tools/plot_run.py swing_up.toml --terms upright.py --view front --out swing_up.png

Moments before the last are outlines, the later the darker; lines are the ways of last links and of objects, the star
is the goal. Fine meshes that move are drawn as their convex hulls. Exit code 2 for bad input.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from scene_picture import COLORS, VIEWS, ScenePicture, natural_view

import warpmpc
from warpmpc.cli.run import start_warp
from warpmpc.cli.terms import load_terms
from warpmpc.run.episode import Episode

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from warpmpc import History, Plant

AUTO = "auto"


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", metavar="SCENE[:VARIANT]")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--terms", type=Path, nargs="+", default=[], metavar="FILE.py", help="cost terms of your own")
    parser.add_argument("--engine", default="auto", help="engine of the rollouts")
    parser.add_argument("--device", default="auto", help="device of the rollouts")
    parser.add_argument(
        "--view", choices=[AUTO, *VIEWS], default=AUTO, help="auto: from above where nothing moves up or down, else 3d"
    )
    parser.add_argument("--curves", action="store_true", help="also the cost of each term and the contact forces")
    parser.add_argument("--snapshots", type=int, default=9, help="moments drawn (default 9)")
    parser.add_argument("--out", type=Path, required=True, help="PNG file")
    args = parser.parse_args(arguments)
    if args.snapshots < 1:
        parser.error("--snapshots must be at least 1")
    return args


def draw_run(axes: Axes, plant: Plant, history: History, *, view: str, snapshots: int) -> None:
    """Draw where everything went.

    Args:
        axes: Where to draw.
        plant: The plant at the end of the run.
        history: The run.
        view: One of :data:`~scene_picture.VIEWS`.
        snapshots: Moments drawn.
    """
    picture = ScenePicture(axes, plant, VIEWS[view])
    picture.ground()
    picture.solid(history.body_q[-1], ("obstacle",))
    moments = np.linspace(0, len(history.time) - 1, snapshots).round().astype(int)
    for n, i in enumerate(moments[:-1]):
        picture.outlines(history.body_q[i], ("object", "robot"), alpha=0.08 + 0.3 * n / len(moments))
    picture.solid(history.body_q[-1], ("object", "robot"))
    for entity in plant.layout.entities:
        if entity.bodies:
            color = [0.7 * value for value in COLORS[entity.kind]]
            picture.path(history.body_q[:, entity.bodies[-1], :3], color=color, lw=1.2)
    if plant.scene.goal is not None:
        picture.path(plant.goal[None, :3], marker="*", color="tab:green", ms=16, zorder=5)
    axes.set_aspect("equal")
    axes.autoscale_view()
    if VIEWS[view].labels is None:
        axes.set_axis_off()
    else:
        axes.set_xlabel(VIEWS[view].labels[0])
        axes.set_ylabel(VIEWS[view].labels[1])


def draw_curves(costs: Axes, forces: Axes | None, history: History) -> None:
    """Draw what each term cost and the contact forces of each pair over time, each curve by its name."""
    for name, values in zip(history.term_names, history.cost_terms.T, strict=True):
        costs.plot(history.time[:-1], values, lw=1.0, label=name)
    costs.plot(history.time[:-1], history.cost, color="k", lw=1.5, label="sum")
    costs.set_ylabel("cost of the best sample")
    if forces is not None:
        for name, force in zip(history.pair_names, np.linalg.norm(history.contact_force, axis=-1).T, strict=True):
            forces.plot(history.time, force, lw=1.0, label=name)
        forces.set_ylabel("contact force [N]")
    for axes in filter(None, (costs, forces)):
        axes.set_xlim(history.time[0], history.time[-1])
        axes.set_xlabel("time [s]")
        axes.legend(fontsize="x-small", loc="center left", bbox_to_anchor=(1.0, 0.5))


def plot(args: argparse.Namespace) -> None:
    """Run an episode and draw it.

    Raises:
        ValueError: If the scene, a file of terms, the engine or the device is wrong.
        OSError: If the picture cannot be written.
    """
    start_warp()
    scene = warpmpc.load_scene(args.scene, overrides=args.overrides)
    terms = load_terms(args.terms)
    episode = Episode(scene, seed=args.seed, engine=args.engine, device=args.device, terms=terms)
    recorder = warpmpc.HistoryRecorder(episode.controller, episode.plant)
    episode.run(recorder=recorder)
    history, plant = recorder.history, episode.plant
    view = natural_view(plant.layout, history.body_q) if args.view == AUTO else args.view
    rows = 1 + args.curves * (1 + bool(history.pair_names))
    figure, axes = plt.subplots(rows, figsize=(7, 5 + 2 * rows), dpi=110, height_ratios=[7, 2, 2][:rows], squeeze=False)
    (axes, *curves) = axes[:, 0]
    if curves:
        figure.subplots_adjust(hspace=0.3)
        draw_curves(curves[0], curves[1] if len(curves) > 1 else None, history)
    draw_run(axes, plant, history, view=view, snapshots=args.snapshots)
    axes.set_title(f"{args.scene}, seed {args.seed}: {plant.reason}, {plant.time:.1f} s")
    args.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(args.out, bbox_inches="tight")
    plt.close(figure)


def main(arguments: list[str] | None = None) -> int:
    """Command line of this tool; returns the exit code."""
    try:
        plot(parse(arguments))
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
