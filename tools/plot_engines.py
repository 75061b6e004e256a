#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Plot plan time against the number of samples, from what tools/engines.py measured on one or several machines.

    python tools/plot_engines.py cpu.json gpu.json --out engines.png
    python tools/plot_engines.py cpu.json gpu.json --scene omni_push_box --out engines.png

Both axes are logarithmic. Lines of GPUs are solid, those of CPUs dashed; dotted is the physics alone.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

ORDER = ("fused", "mujoco", "newton", "kinematic")
"""Engines, each with a colour of its own."""
BARE = {"mujoco": "mujoco.rollout, bare", "newton": "MuJoCo Warp's graph, bare"}
"""What the physics alone is called."""


def plot_rows(rows: list[dict], file: Path) -> None:
    """Plan time against samples, one panel per scene, a line per engine, device and case.

    Args:
        rows: Rows of tools/engines.py.
        file: Picture to write.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    scenes = sorted({row["scene"] for row in rows})
    size = (max(6.0, 5.5 * len(scenes)), 4.8)
    figure, panels = plt.subplots(1, len(scenes), figsize=size, squeeze=False, sharey=True, layout="constrained")
    for scene, axes in zip(scenes, panels[0], strict=True):
        own = [row for row in rows if row["scene"] == scene]
        for engine, place, case in sorted({(row["engine"], where(row), row["case"]) for row in own}):
            line = [row for row in own if (row["engine"], where(row), row["case"]) == (engine, place, case)]
            line.sort(key=lambda row: row["samples"])
            k, colour = [row["samples"] for row in line], f"C{ORDER.index(engine)}"
            label = " ".join(filter(None, (f"{engine}, {place}", case)))
            style = "o-" if row_on_gpu(line[0]) else "s--"
            axes.loglog(k, [row["plan_ms"]["p50"] for row in line], style, color=colour, markersize=4, label=label)
            floors = [(row["samples"], row["floor_ms"]) for row in line if row.get("floor_ms")]
            if floors:
                axes.loglog(*zip(*floors, strict=True), ":", color=colour, label=f"{BARE.get(engine, engine)}, {place}")
        axes.set_title(scene)
        axes.set_xscale("log", base=2)
        axes.xaxis.set_major_formatter(lambda k, _: f"{k:g}")
        axes.set_xlabel("samples K")
        axes.grid(which="both", alpha=0.25)
        axes.legend(fontsize=7)
    panels[0][0].set_ylabel("plan, p50 [ms]")
    figure.savefig(file, dpi=130)
    plt.close(figure)


def where(row: dict) -> str:
    """What a row was measured on, short: the GPU, or how many cores."""
    if row_on_gpu(row):
        return row["device"].removeprefix("NVIDIA ")
    cores = row.get("cores")
    return f"{cores} cores" if cores else "CPU"


def row_on_gpu(row: dict) -> bool:
    """Whether a row was measured on a GPU."""
    return "NVIDIA" in row["device"] or row["device"].startswith("cuda")


def main() -> None:
    """Read, merge, plot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path, help="JSON files of tools/engines.py")
    parser.add_argument("--scene", action="append", help="scenes to plot, all by default; repeatable")
    parser.add_argument("--out", type=Path, default=Path("engines.png"))
    args = parser.parse_args()
    rows = [row for file in args.files for row in json.loads(file.read_text())["rows"]]
    plot_rows([row for row in rows if not args.scene or row["scene"] in args.scene], args.out)
    print(f"{args.out}: {len(rows)} rows")


if __name__ == "__main__":
    main()
