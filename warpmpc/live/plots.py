# SPDX-License-Identifier: Apache-2.0
"""Curves of the page: cost of each term and controls, past and predicted, what β and η are, plan times."""

from __future__ import annotations

from collections import deque
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

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
WIDTH = 330.0
"""Width of the panel [pixels]."""


class Plots:
    """The curves of a session.

    Args:
        server: The page's server.
        session: The session.
    """

    def __init__(self, server: viser.ViserServer, session: Session):
        self._budget, layout = 1e3 * session.scene.timing.control_dt, session.plant.layout
        self._labels, controls = session.controller.costs.labels, layout.control_name
        self._rows: deque[list[float]] = deque(maxlen=KEPT)
        self._episode, self._steps, self._drawn = -1, -1, 0.0
        terms, nu = len(self._labels), len(controls)
        self._widths = (terms, nu, 1, 1, 2)
        panel = server.gui.add_panel()
        panel.dock_left()
        panel.set_width(WIDTH)
        with panel.add_tab("Curves"):
            self._plots = [
                *self._split(server, "cost of a step", self._labels, 0, ahead=True),
                *self._split(server, "control", controls, terms, ahead=True),
                *self._split(server, "effective samples η", ("η",), terms + nu),
                *self._split(server, "temperature β", ("β",), terms + nu + 1),
                *self._split(server, "plan time [ms]", ("plan", "budget"), terms + nu + 2),
            ]

    def _split(
        self, server: viser.ViserServer, title: str, names: Sequence[str], first: int, *, ahead: bool = False
    ) -> list[tuple[object, slice, bool]]:
        """Plots of at most :data:`CURVES` curves each: handle, columns and whether they go on into the future."""
        from viser import uplot

        made = []
        for begin in range(0, len(names), CURVES):
            part = names[begin : begin + CURVES]
            series = [uplot.Series(label="t [s]")]
            for dash in ((), (4, 4)) if ahead else ((),):
                series += [
                    uplot.Series(label=f"{name} ahead" if dash else name, stroke=color, width=1.5, dash=dash)
                    for name, color in zip(part, COLORS, strict=False)
                ]
            handle = server.gui.add_uplot(
                tuple(np.zeros(1) for _ in series),
                tuple(series),
                title=title,
                scales={"x": uplot.Scale(time=False)},
                legend=uplot.Legend(show=len(part) > 1),
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
        costs = np.full(len(self._labels), np.nan) if ahead is None else ahead.cost[:, 0]
        numbers = [snapshot.eta, snapshot.beta, snapshot.plan_ms, self._budget]
        self._rows.append([snapshot.time, *costs, *snapshot.control, *numbers])
        if perf_counter() - self._drawn < PERIOD:
            return
        self._drawn = perf_counter()
        past = np.array(self._rows)
        future = np.zeros((0, past.shape[1]))
        if ahead is not None:
            future = np.full((len(ahead.times), past.shape[1]), np.nan)
            future[:, 0], known = ahead.times, len(self._labels) + ahead.control.shape[1]
            future[:, 1 : 1 + known] = np.hstack([ahead.cost.T, ahead.control])
        for plot, columns, goes_on in self._plots:
            plot.data = _curves(past, future, columns) if goes_on else _curves(past, None, columns)


def _curves(past: np.ndarray, future: np.ndarray | None, columns: slice) -> tuple[np.ndarray, ...]:
    """Times, curves of the past and curves of the future, each as long as the times; NaN where they are not drawn."""
    known = past[:, 1:][:, columns]
    if future is None:
        return tuple(np.ascontiguousarray(c) for c in np.column_stack([past[:, 0], known]).T)
    guessed = future[:, 1:][:, columns]
    times = np.concatenate([past[:, 0], future[:, 0]])
    upper = np.hstack([known, np.full_like(known, np.nan)])
    lower = np.hstack([np.full_like(guessed, np.nan), guessed])
    table = np.vstack([upper, lower])
    order = np.argsort(times, kind="stable")
    return tuple(np.ascontiguousarray(c) for c in np.column_stack([times, table])[order].T)
