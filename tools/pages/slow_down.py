#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Draw success over the speed of the clock, from the results of ``python tools/study.py reproduce slow_down``.

    python tools/pages/slow_down.py                    # build/results/slow_down.json to docs/slow_down.png
    python tools/pages/slow_down.py RESULTS.json PICTURE.png

A plan for every control is the same at every speed: its line is the row of the full speed.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def lines(cells: list[dict]) -> dict[str, list[tuple[float, float, float, float]]]:
    """Speed, rate of success and its 95 % interval, by what plans are made; speeds rise.

    Args:
        cells: Rows ``speed_N`` of the table, N the speed [%].
    """
    rates = {int(cell["name"].removeprefix("speed_")): cell["ours"]["success"] for cell in cells}
    fit = [(0.01 * speed, *(rates[speed][key] for key in ("value", "low", "high"))) for speed in sorted(rates)]
    return {"a plan for every control": [(speed, *fit[-1][1:]) for speed, *_ in fit], "as many plans as fit": fit}


def picture(cells: list[dict], path: Path) -> None:
    """Success over speed, with bars of 95 %."""
    import numpy as np
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.0, 3.4), layout="constrained")
    axes = figure.subplots()
    for shift, (label, rows) in zip((1.02, 0.98), lines(cells).items(), strict=True):  # bars side by side
        speed, rate, low, high = np.array(rows).T
        bars = 100 * np.array([rate - low, high - rate])
        axes.errorbar(shift * speed, 100 * rate, bars, label=label, marker="o", capsize=3)
    axes.set(xscale="log", xlabel="speed of the clock", ylabel="on its feet [%]", ylim=(-3, 103))
    axes.set_xticks(speed, [f"{s:g}" for s in speed])
    axes.invert_xaxis()  # slower to the right
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=150)


def main(results: str = "build/results/slow_down.json", path: str = str(ROOT / "docs" / "slow_down.png")) -> None:
    """Read the results and draw them."""
    picture(json.loads(Path(results).read_text(encoding="utf-8"))["cells"], Path(path))


if __name__ == "__main__":
    main(*sys.argv[1:])
