#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Draw what a stage risk makes of a step's cost and what splines make of the same knots, by the planner's own kernels.

python tools/plot_planners.py --out docs

They are Figs. 1 and 2 of MuJoCo MPC (Howell et al. 2022).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib
import numpy as np
import warp as wp

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from warpmpc.kernels.planning.costs import sum_cost_kernel
from warpmpc.planner.splines import SplineKind, spline_value

RISKS = (-5.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0)
KNOTS = np.array([0.0, 0.8, 0.3, -0.6, -0.2, 0.5])
"""Values of the knots, which stand one after the other at these times."""
TIMES = np.array([0.0, 0.2, 0.4, 0.6, 0.8, 1.0])


def stage_risk(cost: np.ndarray, risk: float) -> np.ndarray:
    """ρ(l; R) of costs ``[n]``: rollouts of one step with one term each."""
    out = wp.zeros(len(cost), dtype=float, device="cpu")
    stage = wp.array(cost[None, None], dtype=float, device="cpu")
    inputs = [stage, wp.zeros(len(cost), dtype=int, device="cpu"), wp.ones(1, dtype=float, device="cpu"), risk, 0]
    wp.launch(sum_cost_kernel, dim=len(cost), inputs=inputs, outputs=[out], device="cpu")
    return out.numpy()


def draw_risks(path: Path) -> None:
    """ρ(l; R) over l in [0, 1]."""
    figure, axes = plt.subplots(figsize=(5.5, 4.0), constrained_layout=True)
    cost, colours = np.linspace(0.0, 1.0, 101), plt.get_cmap("coolwarm")
    for i, risk in enumerate(RISKS):
        colour = "black" if risk == 0.0 else colours(i / (len(RISKS) - 1))
        axes.plot(cost, stage_risk(cost, risk), color=colour, label=f"R = {risk:g}")
    axes.set(xlabel="cost of a step, l", ylabel="ρ(l; R)", xlim=(0.0, 1.0), ylim=(0.0, 3.0))
    axes.legend()
    figure.savefig(path, dpi=110)


def draw_splines(path: Path) -> None:
    """Every kind of spline over the same knots."""
    figure, axes = plt.subplots(figsize=(7.0, 3.6), constrained_layout=True)
    times = np.linspace(-0.05, 1.1, 700)
    for kind in SplineKind:
        values = [spline_value(kind, TIMES, KNOTS[:, None], float(t))[0] for t in times]
        axes.plot(times, values, label=kind.value)
    axes.plot(TIMES, KNOTS, "o", color="black", label="knots")
    axes.set(xlabel="time [s]", ylabel="control")
    axes.legend(ncols=5, loc="upper center", bbox_to_anchor=(0.5, -0.18))
    figure.savefig(path, dpi=110)


def main() -> None:
    """Draw both."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder of the pictures")
    out = parser.parse_args().out
    draw_risks(out / "stage_risk.png")
    draw_splines(out / "splines.png")


if __name__ == "__main__":
    main()
