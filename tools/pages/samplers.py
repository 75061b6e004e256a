#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Draw the ways that four ways to sample lead to, as STORM's Fig. 3 does: runs of ``holonomic_2d`` with one seed.

    python tools/pages/samplers.py                     # to docs/samplers.png
    python tools/pages/samplers.py PICTURE.png SEED

Every panel has the path of one run, a mark every 30 controls, and the five best samples of the plan made there.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tools"))

from studies.paper.tables import TABLES, Cell  # noqa: E402

import warpmpc  # noqa: E402
from warpmpc.loop.run.episode import Episode  # noqa: E402

if TYPE_CHECKING:
    from matplotlib.axes import Axes

EVERY = 30
"""Controls from one mark to the next."""
TOP = 5
"""Samples drawn at each."""


def panel(axes: Axes, cell: Cell, seed: int) -> None:
    """Run one episode and draw it."""
    from matplotlib.patches import Circle

    episode = Episode(warpmpc.load_scene(cell.scenes[0], overrides=cell.overrides), seed=seed)
    plant, places, marks = episode.plant, [], []
    body = plant.layout.frame_body[plant.layout.frame(plant.scene.goal.target)]

    def note(controller: warpmpc.Controller, plant: warpmpc.Plant, control: np.ndarray) -> None:
        if (plant.steps - 1) % EVERY == 0:  # the plan was made at the state before
            best = np.argsort(controller.engine.cost.numpy()[0])[:TOP] * controller.shape.domains
            for way in controller.engine.record(best.tolist()).body_q[:, :, body, :2].swapaxes(0, 1):
                axes.plot(*way.T, color="tab:green", linewidth=0.6, alpha=0.7)
            marks.append(places[-1])
        places.append(plant.body_q[body, :2].copy())

    places.append(plant.body_q[body, :2].copy())
    result = episode.run(on_step=note)
    for post in plant.scene.obstacle:
        axes.add_patch(Circle(post.position[:2], post.size[0], color="0.7"))
    axes.plot(*np.array(places).T, color="tab:blue", linewidth=1.8)
    axes.plot(*np.array(marks).T, "o", color="tab:blue", markersize=4)
    axes.plot(*plant.goal[:2], "*", color="tab:red", markersize=12)
    axes.set(title=cell.title, aspect="equal")
    axes.set_xlabel(f"{result.sim_time:.1f} s" if result.success else result.reason)


def main(path: str = str(ROOT / "docs" / "samplers.png"), seed: str = "0") -> None:
    """Run the four and draw them."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 6.6), layout="constrained")
    for axes, cell in zip(figure.subplots(2, 2, sharex=True, sharey=True).flat, TABLES["sampling"].cells, strict=True):
        panel(axes, cell, int(seed))
    figure.savefig(path, dpi=90)


if __name__ == "__main__":
    main(*sys.argv[1:])
