# SPDX-License-Identifier: Apache-2.0
"""Curves of the page: cost of each term, controls, plan time against its budget."""

from __future__ import annotations

from collections import deque
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import viser

    from .session import Session, Snapshot

PERIOD = 0.3
"""Wall time between two pictures of the curves [s]; browsers without a GPU are slow at them."""
KEPT = 300
"""Points of a curve."""
COLORS = ("#e6194b", "#3cb44b", "#4363d8", "#f58231", "#911eb4", "#17a2b8", "#b8860b", "#f032e6", "#808000", "#9a6324")


class Plots:
    """The curves of a session.

    Args:
        server: The page's server.
        session: The session.
    """

    def __init__(self, server: viser.ViserServer, session: Session):
        self._dt, layout = 1e3 * session.scene.timing.control_dt, session.plant.layout
        self._labels = (*session.controller.costs.labels, "total")
        self._times: deque[float] = deque(maxlen=KEPT)
        self._rows: deque[list[float]] = deque(maxlen=KEPT)
        self._episode, self._steps = -1, -1
        self._drawn = 0.0
        with server.gui.add_folder("Curves", expand_by_default=True):
            self._plots = [
                self._add(server, "cost", self._labels),
                self._add(server, "control", layout.control_name),
                self._add(server, "plan [ms]", ("plan", "budget")),
            ]
        self._sizes = (len(self._labels), len(layout.control_name), 2)

    def _add(self, server: viser.ViserServer, title: str, names: tuple[str, ...]) -> object:
        from viser import uplot

        series = [uplot.Series(label="t [s]")]
        series += [uplot.Series(label=n, stroke=COLORS[i % len(COLORS)], width=1.5) for i, n in enumerate(names)]
        data = tuple(np.zeros(1) for _ in series)
        scales = {"x": uplot.Scale(time=False)}
        return server.gui.add_uplot(data, tuple(series), title=title, scales=scales, aspect=1.6)

    def update(self, snapshot: Snapshot) -> None:
        """Add a snapshot's numbers."""
        if snapshot.episode != self._episode:
            self._times.clear()
            self._rows.clear()
            self._episode = snapshot.episode
        elif snapshot.steps == self._steps:
            return
        self._steps = snapshot.steps
        costs = [snapshot.terms.get(label, np.nan) for label in self._labels]
        self._times.append(snapshot.time)
        self._rows.append([*costs, *snapshot.control, snapshot.plan_ms, self._dt])
        if perf_counter() - self._drawn < PERIOD:
            return
        self._drawn = perf_counter()
        times, table = np.array(self._times), np.nan_to_num(np.array(self._rows), posinf=0.0, neginf=0.0)
        for plot, columns in zip(self._plots, np.split(table.T, np.cumsum(self._sizes)[:-1]), strict=True):
            plot.data = (times, *(np.ascontiguousarray(c) for c in columns))
