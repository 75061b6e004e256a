# SPDX-License-Identifier: Apache-2.0
"""A table's distributions as a picture, in the manner of the paper's figures 3 and 4."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from .metrics import METRICS
from .report import Report

OURS, PAPER = "tab:blue", "tab:red"


def plot(report: Report, path: Path) -> bool:
    """Draw every run of a table: one panel per metric, one violin per cell, the paper's figure beside it.

    Args:
        report: The table with its runs.
        path: PNG file.

    Returns:
        Whether there was anything to draw.
    """
    panels = {}
    for name in report.table.metrics:
        values = [[v for record in row.records if (v := METRICS[name].of(record)) is not None] for row in report.rows]
        if not METRICS[name].rate and any(values):
            panels[name] = values
    if not panels:
        return False
    height = 0.5 + 0.38 * len(report.rows)
    figure, axes = plt.subplots(1, len(panels), figsize=(1.6 + 2.5 * len(panels), 0.9 + height), squeeze=False)
    for ax, (name, values) in zip(axes[0], panels.items(), strict=True):
        for place, (row, points) in enumerate(zip(report.rows, values, strict=True)):
            _distribution(ax, place, np.array(points, dtype=float))
            if name in row.cell.paper:
                average, *spread = row.cell.paper[name]
                ax.errorbar(average, place, xerr=spread or None, fmt="D", ms=5, capsize=3, color=PAPER, zorder=4)
        ax.set_xlabel(METRICS[name].heading)
        ax.set_yticks(range(len(report.rows)), [row.cell.name for row in report.rows] if ax is axes[0, 0] else [])
        ax.set_ylim(len(report.rows) - 0.4, -0.6)
        ax.set_xlim(left=min(0.0, ax.get_xlim()[0]))
        ax.grid(axis="x", alpha=0.3)
        ax.spines[["top", "right"]].set_visible(False)
    handles = [plt.Line2D([], [], color=OURS, marker="o", ls="", label="warpmpc, each run")]
    handles.append(plt.Line2D([], [], color=PAPER, marker="D", ls="", label="paper"))
    figure.legend(handles=handles, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130, bbox_inches="tight")
    plt.close(figure)
    return True


def _distribution(ax, place: int, points: np.ndarray) -> None:
    """One cell's runs: a violin behind a box and the points themselves."""
    if len(points) == 0:
        return
    if len(points) >= 5 and np.ptp(points) > 0.0:
        for body in ax.violinplot(points, [place], orientation="horizontal", widths=0.8, showextrema=False)["bodies"]:
            body.set(facecolor=OURS, alpha=0.2)
    if len(points) >= 3:
        median = {"color": "black", "lw": 1.5}
        ax.boxplot(points, positions=[place], orientation="horizontal", widths=0.3, sym="", medianprops=median)
    shift = 0.08 * np.sin(2.4 * np.arange(len(points)))  # apart, yet the same in every drawing
    ax.plot(points, place + shift, "o", ms=2.5, color=OURS, alpha=0.7, zorder=3)
