# SPDX-License-Identifier: Apache-2.0
"""Curves of the page: cost of each term and controls, past and predicted, foresight, what β and η are, plan times."""

from __future__ import annotations

from collections import deque
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from ..plant.foresight import AHEAD

if TYPE_CHECKING:
    from collections.abc import Sequence

    import viser

    from .session import Session
    from .snapshot import Snapshot

PERIOD = 0.3
"""Wall time between two pictures of the curves [s]; browsers without a GPU are slow at them."""
KEPT = 300
"""Points of a curve."""
CURVES = 8
"""Curves of one plot, that can still be told apart."""
COLORS = ("#e6194b", "#3cb44b", "#4363d8", "#f58231", "#911eb4", "#17a2b8", "#b8860b", "#f032e6")
AHEAD_COLOR = "rgba(0, 0, 0, 0.07)"
FORESIGHT = f"cost of the last {AHEAD:g} s: foreseen, came"
WIDTH = 330.0
"""Width of the panel [pixels]."""


class Plots:
    """The curves of a session."""

    def __init__(self, server: viser.ViserServer, session: Session):
        self._budget, layout = 1e3 * session.scene.timing.control_dt, session.plant.layout
        self._labels, controls = session.controller.costs.labels, layout.control_name
        self._rows: deque[list[float]] = deque(maxlen=KEPT)
        self._episode, self._steps, self._drawn = -1, -1, 0.0
        terms, nu = len(self._labels), len(controls)
        self._widths = (terms, nu, 1, 1, 2, 2)
        self.panel = server.gui.add_panel()
        """The panel, for further tabs."""
        self.panel.dock_left()
        self.panel.set_width(WIDTH)
        with self.panel.add_tab("Curves"):
            self._plots = [
                *self._split(server, "cost of a step", self._labels, 0, ahead=True),
                *self._split(server, "control", controls, terms, ahead=True),
                *self._split(server, "effective samples η", ("η",), terms + nu),
                *self._split(server, "temperature β", ("β",), terms + nu + 1),
                *self._split(server, "plan time [ms]", ("plan", "budget"), terms + nu + 2),
            ]
            if session.foresight.known:
                self._plots += self._split(server, FORESIGHT, ("foreseen", "came"), terms + nu + 4)

    def _split(
        self, server: viser.ViserServer, title: str, names: Sequence[str], first: int, *, ahead: bool = False
    ) -> list[tuple[object, slice, bool]]:
        """Plots of at most :data:`CURVES` curves each: handle, columns and whether they go on into the future."""
        from viser import uplot

        made = []
        for begin in range(0, len(names), CURVES):
            part = names[begin : begin + CURVES]
            series = [uplot.Series(label="t [s]")]
            if ahead:
                series.append(uplot.Series(label="ahead", scale="ahead", fill=AHEAD_COLOR, width=0))
            series += [
                uplot.Series(label=name, stroke=color, width=1.5) for name, color in zip(part, COLORS, strict=False)
            ]
            handle = server.gui.add_uplot(
                tuple(np.zeros(1) for _ in series),
                tuple(series),
                title=title,
                scales={"x": uplot.Scale(time=False), "ahead": uplot.Scale(range=(0.0, 1.0))},
                legend=uplot.Legend(show=len(names) > 1),
                aspect=1.8,
            )
            made.append((handle, slice(first + begin, first + begin + len(part)), ahead))
        return made

    def update(self, snapshot: Snapshot) -> None:
        """Add a snapshot's numbers."""
        if snapshot.episode != self._episode:
            self._rows.clear()
            self._episode = snapshot.episode
        elif snapshot.steps == self._steps:
            return
        self._steps, ahead = snapshot.steps, snapshot.forecast
        if ahead is not None:
            seen = snapshot.foreseen
            numbers = [snapshot.eta, snapshot.beta, snapshot.plan_ms, self._budget]
            numbers += [np.nan, np.nan] if seen is None else [seen.cost, seen.came]
            self._rows.append([snapshot.time, *ahead.cost[:, 0], *snapshot.control, *numbers])
        if perf_counter() - self._drawn < PERIOD or not self._rows:
            return
        self._drawn = perf_counter()
        past = np.array(self._rows)
        future = past[:0]
        if ahead is not None:
            future, known = np.zeros((len(ahead.times), past.shape[1])), sum(self._widths[:2])
            future[:, 0] = ahead.times
            future[:, 1 : 1 + known] = np.hstack([ahead.cost.T, ahead.control])
        for plot, columns, goes_on in self._plots:
            plot.data = _curves(past, future, columns) if goes_on else _curves(past, None, columns)


def _curves(past: np.ndarray, future: np.ndarray | None, columns: slice) -> tuple[np.ndarray, ...]:
    """Times, whether they are ahead if there is a future, and curves; where one is not finite it keeps its value."""
    rows = past if future is None else np.vstack([past, future])
    times, curves = rows[:, 0], [_kept(curve) for curve in rows[:, 1:][:, columns].T]
    order = np.argsort(times, kind="stable")
    marks = [] if future is None else [np.repeat([0.0, 1.0], [len(past), len(future)])]
    return tuple(np.ascontiguousarray(row[order]) for row in (times, *marks, *curves))


def _kept(curve: np.ndarray) -> np.ndarray:
    """A curve ``[n]`` whose values that are not finite are the finite one before; browsers do not draw others."""
    finite = np.flatnonzero(np.isfinite(curve))
    if not len(finite):
        return np.zeros_like(curve)
    return curve[finite[np.maximum(np.searchsorted(finite, np.arange(len(curve)), side="right") - 1, 0)]]
