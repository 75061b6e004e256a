# SPDX-License-Identifier: Apache-2.0
"""Sources of a robot as its driver hears them: rates, ages, and what is wrong with them."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, field

import numpy as np

logger = logging.getLogger("warpmpc")

BACK = 1.0
"""Time by which a message may be older than the newest and count as overtaken, not as of a clock that was set [s]."""
AHEAD = 0.1
"""Time by which a message may be ahead of what has passed since the newest came [s]."""
AGREED = 0.1
"""Time for which messages agree before a jump of their times is one of the robot's clock [s]."""


class Stamps:
    """Tells the times of a source's messages from one that is wrong: those after it are not taken for overtaken."""

    def __init__(self):
        self._newest = self._doubted = (np.nan, np.nan)  # time of a message, and when it came

    def believes(self, stamp: float) -> bool:
        """Take note of the time of a message that came now [s]; return whether it can be true."""
        now = time.monotonic()
        if np.isnan(self._newest[0]) or self._fits(stamp, now, *self._newest):
            self._doubted = (np.nan, np.nan)
            if not stamp <= self._newest[0]:
                self._newest = stamp, now
            return True
        if not self._fits(stamp, now, *self._doubted):
            self._doubted = stamp, now
        elif now - self._doubted[1] >= AGREED:
            self._newest, self._doubted = (stamp, now), (np.nan, np.nan)
            return True
        return False

    def _fits(self, stamp: float, now: float, newest: float, came: float) -> bool:
        return -BACK < stamp - newest <= now - came + AHEAD


@dataclass
class Heard:
    """Messages of one source, such as a topic or an address; a driver calls :meth:`note` for each that it looks at."""

    source: str
    """Topic or address."""
    content: str
    """What is expected of it."""
    count: int = 0
    """Messages that could be used."""
    refused: int = 0
    """Messages that could not."""
    problem: str | None = None
    """Why the last of those could not, and the cure."""
    stamp: float = np.nan
    """Time of the newest message on the robot's clock [s]."""
    _first: float = field(default=np.nan, repr=False)
    _last: float = field(default=np.nan, repr=False)

    def note(self, stamp: float) -> None:
        """Take note of a message.

        Args:
            stamp: Its time on the robot's clock [s].
        """
        self._last = time.monotonic()
        self._first = self._last if not self.count else self._first
        self.count += 1
        self.stamp = stamp

    def refuse(self, problem: str) -> None:
        """Take note of a message that cannot be used; the log has the first of a source that could be used before."""
        if not self.refused and self.count:
            logger.warning("%s: %s", self.source, problem)
        self.refused += 1
        self.problem = problem

    @property
    def rate(self) -> float:
        """Messages in a second of wall time [Hz]; NaN before the second."""
        lapse = self._last - self._first
        return (self.count - 1) / lapse if lapse > 0.0 else np.nan

    @property
    def age(self) -> float:
        """Wall time since the newest message came [s]; NaN before the first."""
        return time.monotonic() - self._last

    @property
    def missing(self) -> str | None:
        """A sentence about what keeps the source from being used, None where nothing does."""
        if self.count:
            return None
        if self.problem is not None:
            return f"{self.source}: {self.problem}"
        return f"nothing came from {self.source}: is the robot on, and does it send {self.content} there?"
