# SPDX-License-Identifier: Apache-2.0
"""Ticks at a fixed rate, and how late they were."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence

import numpy as np

LONGEST = 200_000
"""Newest numbers of a series that are kept."""
WINDOW = 1.0
"""Newest observations that the robot's clock is read from [s]."""
JUMP, SOON = 0.025, 0.05
"""Time by which an observation may be ahead of the clock at once, and for which those farther ahead agree first [s]."""
BEHIND = 0.1
"""Wall time by which a simulated robot may be behind and still catch up [s]; beyond it, its clock slips."""


class NewestNumbers:
    """The newest numbers of a series, in memory that is taken at once."""

    last = 0.0
    """The newest; 0 before the first."""

    def __init__(self):
        self._values, self._count = np.full(LONGEST, np.nan), 0

    def append(self, value: float) -> None:
        """Take note of a number."""
        self._values[self._count % LONGEST] = self.last = value
        self._count += 1

    def values(self) -> np.ndarray:
        """The numbers that are kept ``[n]``, the newest last."""
        if self._count <= LONGEST:
            return self._values[: self._count]
        return np.roll(self._values, -(self._count % LONGEST))


def percentiles(values: Sequence[float] | np.ndarray) -> dict[str, float]:
    """``p50``, ``p99`` and ``max`` of numbers ``[n]``; NaN of none."""
    found = np.percentile(values, [50, 99, 100]).tolist() if len(values) else [np.nan] * 3
    return dict(zip(("p50", "p99", "max"), found, strict=True))


class Pace:
    """Waits for ticks on its own schedule, so that a late one does not delay those after it.

    Args:
        period: Time between ticks on the robot's clock [s].
        speed: The robot's seconds in a second of wall time; below 1 a simulated robot is slowed down.
        skip: Whether missed ticks are left out, as the clock of a real robot does not wait.
            Without, the clock waits: all ticks are made, and slip when they are too far behind.
    """

    missed: int
    """Ticks whose work was not done when the next one was due."""
    slipped: float
    """Wall time that the clock waited [s]."""

    def __init__(self, period: float, *, speed: float = 1.0, skip: bool = True):
        self.period, self.speed, self.skip = period, speed, skip
        self.late = NewestNumbers()
        """Lateness of ticks [s]."""
        self.missed, self.slipped = 0, 0.0
        self._tick, self._past = 0, 0.0  # and how late it is on a real robot's clock [s]
        self._begin: float | None = None  # when tick 0 was due, on the monotonic clock [s]

    @property
    def now(self) -> float:
        """Time of the present tick on the robot's clock, since the start [s]; a real robot's does not wait for it."""
        return self._tick * self.period + self._past

    def start(self) -> None:
        """The present tick is now; a real robot's clock went on since it was started before."""
        now, wall = time.monotonic(), self.period / self.speed
        if self.skip and self._begin is not None:
            self._tick = max(self._tick, int((now - self._begin) / wall))
            self._past = max(0.0, now - self._begin - self._tick * wall) * self.speed
        else:
            self._begin = now - self._tick * wall

    def wait(self) -> float:
        """Wait for the next tick; returns :attr:`now`."""
        wall = self.period / self.speed
        self._tick += 1
        rest = self._begin + self._tick * wall - time.monotonic()
        if rest > 0.0:
            time.sleep(rest)
        else:
            self.missed += 1
            if self.skip:
                self._tick += int(-rest / wall)
            elif -rest > BEHIND:
                self.slipped -= rest
                self._begin -= rest
        late = time.monotonic() - self._begin - self._tick * wall
        self.late.append(late)
        if self.skip:
            self._past = late * self.speed
        return self.now

    def jitter_ms(self) -> dict[str, float]:
        """Lateness of ticks [ms]: ``p50``, ``p99``, ``max``; NaN before the first."""
        return percentiles(1e3 * self.late.values())


class RobotClock:
    """Tells the robot's time at a tick, from the times of its observations.

    Observations take their time, some more than others. The robot's clock is where the least delayed of the last
    second says: it may start anywhere, drift and slip, but a delay that never ends cannot be told from a slip. Ticks
    are those of this host's monotonic clock: a time that goes back, or ahead of them by a jump, is not believed at
    once. All of :data:`SOON` that are ahead by as much, up to a second, show a shorter delay; all of a second that
    are off by as much, of a clock that was set.

    Args:
        jump: Time by which an observation may be ahead and be believed at once [s].
    """

    def __init__(self, jump: float = JUMP):
        self._jump = jump
        self._seen: deque[tuple[float, float]] = deque()  # tick, and by how much the robot's clock was ahead of it
        self._newest = -np.inf
        self._ahead = 0.0
        self._doubted: list[tuple[float, float]] = []  # tick and time of those not believed: the first, the newest

    def see(self, time: float, tick: float) -> None:
        """Take note of an observation's time, if it is a new one.

        Args:
            time: Time of the observation [s].
            tick: Time of the tick that saw it [s].
        """
        if not np.isfinite(time) or time == self._newest:
            return
        ahead = time - tick
        later = time > self._newest
        if self._seen and not (later and ahead <= self._ahead + self._jump):
            if not self._was_set(time, tick, SOON if later and ahead <= self._ahead + WINDOW else WINDOW):
                return
            self._seen.clear()
        self._newest = time
        self._doubted.clear()
        while self._seen and self._seen[0][0] < tick - WINDOW:
            self._seen.popleft()
        self._seen.append((tick, ahead))
        self._ahead = max(ahead for _, ahead in self._seen)

    def _was_set(self, time: float, tick: float, lasting: float) -> bool:
        """Return whether times that are not believed, this one the newest, have agreed for long enough [s]."""
        if self._doubted:
            begin, first = self._doubted[0]
            if abs(time - first - (tick - begin)) > lasting:
                self._doubted.clear()
            elif time > self._doubted[-1][1]:
                self._doubted[1:] = [(tick, time)]
                return tick - begin >= lasting
            else:
                return False
        self._doubted.append((tick, time))
        return False

    def at(self, tick: float) -> float:
        """The robot's time at a tick [s]."""
        return tick + self._ahead


def slow_plans(plan_ms: float, control_dt: float, *, speed: float = 1.0) -> str | None:
    """Advice on plans that are slower than the controls they are for; None where they are not.

    Args:
        plan_ms: Wall time of a plan, the median of several [ms].
        control_dt: Length of a control [s].
        speed: The robot's seconds in a second of wall time that are wanted.
    """
    period = 1e3 * control_dt
    if not plan_ms > period / speed:
        return None
    wanted = f"speed {speed:g}" if speed != 1.0 else "real time"
    return (
        f"{wanted} would need a plan every {period / speed:.4g} ms of wall time, a plan takes {plan_ms:.1f} ms: lower "
        "planner.samples, planner.horizon or engine.substeps, raise timing.control_dt, or slow a simulated robot down "
        f"with --real-time --speed {0.9 * period / plan_ms:.2g}"
    )
