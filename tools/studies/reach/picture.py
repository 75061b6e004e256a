# SPDX-License-Identifier: Apache-2.0
"""Picture of arms that follow what moves: where hand and ball are, how far apart, and how near the arm came."""

from __future__ import annotations

from pathlib import Path

import numpy as np

LAWS = {"": ("planner", "k", "C1"), "_osc": ("OSC", "0.55", "#f4cf9f")}
"""Ends of the files' names: what a legend says, colours of the hand's distance and the arm's."""


def draw(folder: Path, scenes: list[str], path: Path) -> None:
    """Draw the first run of each scene, by the planner and, where there is one, by operational-space control.

    Args:
        folder: Holds SCENE.npz and SCENE_osc.npz of ``study.py track``.
        scenes: Names of the scenes, as they were run.
        path: Where the picture goes.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.2 * len(scenes), 5.2), layout="constrained")
    rows = figure.subplots(2, len(scenes), squeeze=False, sharex="col")
    for (upper, lower), scene in zip(rows.T, scenes, strict=True):
        for end, (law, hand, arm) in LAWS.items():
            file = folder / f"{scene.replace(':', '_')}{end}.npz"
            if end and not file.exists():
                continue
            run = dict(np.load(file))
            time, tool, goal = run["time"], run["tool"][:, :3], run["goal"][:, :3]
            if not end:
                for i, (axis, color) in enumerate(zip("xyz", ("C3", "C2", "C0"), strict=True)):
                    upper.plot(time, goal[:, i], color=color, linestyle="--", linewidth=0.8)
                    upper.plot(time, tool[:, i], color=color, label=axis)
            miss, near = np.linalg.norm(tool - goal, axis=1), run["clearance"].clip(min=1e-4)
            lower.plot(time, 1e3 * miss, color=hand, label=f"hand to ball, {law}")
            lower.plot(time, 1e3 * near, color=arm, label=f"arm to obstacles, {law}")
        upper.set(title=scene, ylabel="ball (dashed), hand [m]")
        lower.set(xlabel="time [s]", ylabel="distance [mm]", yscale="log", ylim=(1.0, 500.0))
        for axes in (upper, lower):
            axes.grid(alpha=0.3)
            axes.legend(loc="upper right", fontsize="x-small", ncols=2)
    figure.savefig(path, dpi=100)
