# SPDX-License-Identifier: Apache-2.0
"""State of a session at one moment.

Plans in a second of wall time, and how long they take.
"""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from ...planner.controller.rollout_paths import RolloutPaths
    from .foresight import Forecast, Foreseen


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """Everything that is shown after a step; arrays are copies."""

    source: str
    """Scene and variant: what is listed begins anew when they change."""
    build: int
    """Counts plants built: what is drawn begins anew when it changes."""
    episode: int
    """Counts resets: curves begin anew when it changes."""
    time: float
    """Simulated time [s]."""
    steps: int
    body_q: np.ndarray
    """Poses of the bodies ``[nb, 7]``."""
    joint_q: np.ndarray
    """Joint coordinates ``[nq]``."""
    sensor: np.ndarray
    """Numbers of all sensors ``[ns]``."""
    poses: dict[str, np.ndarray]
    """Goal, targets and movable obstacles ``[7]``."""
    values: dict[str, float]
    """Weights and scalars of the task by name, parameters of norms by key (``cost.head.norm.p``)."""
    paths: RolloutPaths | None
    """Best rollout and fan; None without a plan."""
    forecast: Forecast | None
    """Cost and controls that the best rollout expects; None without a plan."""
    forces: np.ndarray
    """Net forces of the plant's pairs ``[pairs, 3]`` [N]."""
    pull: np.ndarray | None
    """Ends of the spring that pulls at a body ``[2, 3]`` [m]; None without."""
    control: np.ndarray
    cost: float
    """Cost of the best rollout; NaN without a plan."""
    eta: float
    proposer: str
    """Where the plan comes from, one of ``PROPOSERS``; empty without a plan."""
    beta: float
    plan_ms: float
    plans: float
    """Plans made for each of the last controls; NaN without."""
    rate: PlanRate
    """How many plans are made, and how long they take."""
    age: float
    """Age of the plan in use: time since the observation that it was made from [s]; NaN without."""
    foreseen: Foreseen | None
    """The newest prediction beside what came; None before the first."""
    status: str
    """Status in words."""
    paused: bool
    planning: bool
    controlling: bool
    lock_step: bool
    recording: str
    """File that is recorded to; empty without."""
    message: str
    """Error of the last change that could not be made; empty when all is well."""


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
