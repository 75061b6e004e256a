#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Draw what tools/track.py kept of runs, one column each: where ball and hand were, and how far from what.

python tools/plot_track.py build/track/storm_track.npz build/track/storm_track_walls.npz --out docs/storm_track.png
python tools/plot_track.py build/track/storm_hold_orientation.npz --rotation --out docs/storm_hold_orientation.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

AXES = (("x", "tab:red"), ("y", "tab:green"), ("z", "tab:blue"))
PAPER = (1.2485, 3.0)
"""Median and bound of STORM's orientation error [%]."""


def draw_places(axes, rows: dict[str, np.ndarray]) -> None:
    """Coordinates of the ball as it was seen, as it was, and of the hand."""
    for i, (name, color) in enumerate(AXES):
        axes.plot(rows["time"], rows["seen"][:, i], ",", color=color, alpha=0.5)
        axes.plot(rows["time"], rows["goal"][:, i], "--", color=color, lw=0.9)
        axes.plot(rows["time"], rows["tool"][:, i], color=color, lw=1.4, label=name)
    axes.set_ylabel("ball (dashed), hand [m]")
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.97), ncols=3, frameon=False)


def draw_distances(axes, rows: dict[str, np.ndarray]) -> None:
    """Distance of the hand from the ball, and of the arm from all obstacles."""
    miss = np.linalg.norm(rows["tool"][:, :3] - rows["goal"][:, :3], axis=1)
    axes.semilogy(rows["time"], 1e3 * miss, color="black", lw=1.2, label="hand to ball")
    axes.semilogy(rows["time"], 1e3 * rows["clearance"], color="tab:orange", lw=1.0, label="arm to obstacles")
    axes.set_ylim(1.0, 500.0)
    axes.set_ylabel("distance [mm]")
    axes.legend(loc="lower right", ncols=2, frameon=False)


def draw_rotation(axes, rows: dict[str, np.ndarray]) -> None:
    """Orientation error, 100 (1 - |<q, q_g>|)."""
    dot = np.abs((rows["tool"][:, 3:] * rows["goal"][:, 3:]).sum(axis=1)).clip(max=1.0)
    axes.semilogy(rows["time"], np.maximum(100.0 * (1.0 - dot), 1e-5), color="tab:purple", lw=1.2)
    for value, style, name in zip(PAPER, ("--", ":"), ("STORM's median", "STORM's bound"), strict=True):
        axes.axhline(value, color="tab:red", ls=style, lw=1.0, label=name)
    axes.set_ylabel("100 (1 - |<q, q_g>|) [%]")
    axes.legend(loc="lower right", frameon=False)


def main() -> None:
    """Command line of this tool."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN.npz")
    parser.add_argument("--rotation", action="store_true", help="the orientation error, too")
    parser.add_argument("--out", type=Path, required=True, help="PNG file")
    args = parser.parse_args()
    panels = [draw_places, draw_distances, *([draw_rotation] if args.rotation else [])]
    size = 6.2 * len(args.runs), 2.6 * len(panels)
    figure, grid = plt.subplots(len(panels), len(args.runs), figsize=size, dpi=100, sharex="col", squeeze=False)
    for column, path in zip(grid.T, args.runs, strict=True):
        with np.load(path) as data:
            rows = dict(data)
        for panel, axes in zip(panels, column, strict=True):
            panel(axes, rows)
            axes.grid(alpha=0.3)
        column[0].set_title(path.stem)
        column[-1].set_xlabel("time [s]")
    figure.tight_layout()
    args.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(args.out)


if __name__ == "__main__":
    main()
