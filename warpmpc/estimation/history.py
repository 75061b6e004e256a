# SPDX-License-Identifier: Apache-2.0
"""Measurements of the last time with the estimates after them, so that late ones come to stand where they belong."""

from __future__ import annotations

from bisect import bisect_right
from typing import Generic, Protocol, TypeVar

import numpy as np

Estimate = TypeVar("Estimate")
Measured = TypeVar("Measured")

KEPT = 1.0
"""Age of the oldest measurement that is kept, counted from the newest [s]."""


class Filter(Protocol[Estimate, Measured]):
    """Filter whose estimates are values with a ``time``."""

    def start(self, measurement: Measured) -> Estimate:
        """The estimate after the first measurement."""

    def predict(self, estimate: Estimate, time: float) -> Estimate:
        """The estimate at a later time [s]."""

    def correct(self, estimate: Estimate, measurement: Measured) -> Estimate:
        """The estimate with a measurement of its time."""

    def reach(self, estimate: Estimate, time: float) -> Estimate:
        """The estimate at a time [s] at which nothing was measured."""


class History(Generic[Estimate, Measured]):
    """Ring buffer of measurements of one thing, in the order of their times and of their kinds.

    A late one goes to its place and those after it are taken in again, so that the estimate is the one of measurements
    that came in order (Bar-Shalom 2002 calls it reprocessing). Of two of one kind and time the first counts.

    Args:
        filter: The filter.
    """

    def __init__(self, filter: Filter[Estimate, Measured]):
        self.filter = filter
        self.reset()

    def reset(self) -> None:
        """Forget every measurement."""
        self._keys: list[tuple[float, float]] = []  # time and order
        self._measured: list[Measured] = []
        self._after: list[Estimate] = []
        self._whole = True  # whether the first measurement of all is among them
        self.too_late = 0
        """Measurements that were older than all that are kept, and left out."""

    def insert(self, measurement: Measured) -> None:
        """Take in a measurement."""
        key = (measurement.time, measurement.order)
        place = bisect_right(self._keys, key)
        if place == 0 and not self._whole:
            self.too_late += 1
            return
        if place and self._keys[place - 1] == key:
            return
        self._keys.insert(place, key)
        self._measured.insert(place, measurement)
        del self._after[place:]
        for taken in self._measured[place:]:
            self._after.append(self._with(taken))
        while self._keys[-1][0] - self._keys[0][0] > KEPT:
            self._whole = False
            for rows in (self._keys, self._measured, self._after):
                del rows[0]

    def _with(self, measurement: Measured) -> Estimate:
        if not self._after:
            return self.filter.start(measurement)
        return self.filter.correct(self.filter.predict(self._after[-1], measurement.time), measurement)

    def at(self, time: float) -> Estimate | None:
        """The estimate at a time [s] from what was measured until then, the first one before it; None without any."""
        if not self._after:
            return None
        return self.filter.reach(self._after[max(bisect_right(self._keys, (time, np.inf)) - 1, 0)], time)
