# SPDX-License-Identifier: Apache-2.0
"""Plans in a second of wall time, and how long they take."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass

import numpy as np

WINDOW = 2.0
"""Wall time over which plans are counted [s]."""
KEPT = 200
"""Newest plans whose times are told."""


@dataclass(frozen=True)
class PlanRate:
    """Rate and times of the newest plans; times are NaN without one."""

    rate: float
    """Plans in a second of wall time [1/s]."""
    p50: float
    """Median wall time of a plan [ms]."""
    p99: float
    """Wall time that 99 of 100 plans keep [ms]."""


class PlanCounter:
    """Takes note of plans in the thread that makes them, and tells their rate in any other."""

    def __init__(self):
        self._ends: deque[float] = deque(maxlen=10_000)  # on the clock of perf_counter [s]
        self._times: deque[float] = deque(maxlen=KEPT)  # [ms]

    def note(self, plan_ms: float) -> None:
        """Count a plan that has just been made and took so long [ms]."""
        self._ends.append(time.perf_counter())
        self._times.append(plan_ms)

    def forget(self) -> None:
        """Begin anew."""
        self._ends.clear()
        self._times.clear()

    def now(self) -> PlanRate:
        """The rate of the last :data:`WINDOW`, and times of the last :data:`KEPT` plans."""
        begin, times = time.perf_counter() - WINDOW, tuple(self._times)
        p50, p99 = np.percentile(times, [50, 99]) if times else (np.nan, np.nan)
        return PlanRate(sum(end > begin for end in tuple(self._ends)) / WINDOW, float(p50), float(p99))
