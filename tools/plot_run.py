#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Draw one closed-loop run from above.

python tools/plot_run.py omni_push_box --seed 0 --out docs/omni_push_box.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.patches import Circle, Polygon
from scipy.spatial.transform import Rotation

import warpmpc
from warpmpc.run.episode import Episode

COLORS = {"robot": "tab:orange", "object": "tab:blue", "obstacle": "0.4"}


def outline(layout, shape, pose: np.ndarray, **style):
    """The patch of a shape seen from above."""
    turn = Rotation.from_quat(pose[3:])
    local = Rotation.from_quat(shape.pose[3:])
    centre = pose[:3] + turn.apply(shape.pose[:3])
    if shape.kind in ("sphere", "cylinder", "capsule"):
        return Circle(centre[:2], shape.scale[0], **style)
    x, y, _ = shape.scale
    corners = np.array([[x, y, 0], [-x, y, 0], [-x, -y, 0], [x, -y, 0]])
    return Polygon((centre + (turn * local).apply(corners))[:, :2], closed=True, **style)


def draw(axes, layout, body_q: np.ndarray, *, alpha: float, kinds: tuple[str, ...]) -> None:
    """Draw the primitive shapes of all entities of some kinds at one moment."""
    for entity in layout.entities:
        if entity.kind not in kinds:
            continue
        for i in entity.shapes:
            shape = layout.shapes[i]
            if shape.kind in ("plane", "mesh") or not shape.collides:
                continue
            pose = body_q[shape.body] if shape.body >= 0 else np.array([0, 0, 0, 0, 0, 0, 1.0])
            color = COLORS[entity.kind]
            axes.add_patch(outline(layout, shape, pose, facecolor=color, edgecolor=color, alpha=alpha, lw=0.8))


def main() -> None:
    """Command line of this tool."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--snapshots", type=int, default=9, help="moments drawn (default 9)")
    parser.add_argument("--out", type=Path, required=True, help="PNG file")
    args = parser.parse_args()

    scene = warpmpc.load_scene(args.scene, overrides=args.overrides)
    episode = Episode(scene, seed=args.seed)
    layout, frames = episode.controller.layout, [episode.plant.body_q]
    episode.run(on_step=lambda controller, plant, control: frames.append(plant.body_q))
    figure, axes = plt.subplots(figsize=(7, 7), dpi=110)
    draw(axes, layout, frames[0], alpha=0.9, kinds=("obstacle",))
    shown = np.linspace(0, len(frames) - 1, args.snapshots).round().astype(int)
    for n, i in enumerate(shown):
        draw(axes, layout, frames[i], alpha=0.12 + 0.5 * n / len(shown), kinds=("object", "robot"))
    track = np.array(frames)
    for entity in layout.entities:
        if entity.bodies:
            path = track[:, entity.bodies[-1], :2]
            axes.plot(path[:, 0], path[:, 1], color=COLORS[entity.kind], lw=1.2)
    axes.plot(*episode.plant.goal[:2], marker="*", color="tab:green", ms=16, zorder=5)
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    plant = episode.plant
    axes.set_title(f"{args.scene}, seed {args.seed}: {plant.reason}, {plant.time:.1f} s")
    args.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(args.out, bbox_inches="tight")


if __name__ == "__main__":
    main()
