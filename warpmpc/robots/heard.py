# SPDX-License-Identifier: Apache-2.0
"""Sources of a robot as its driver hears them: rates, ages, and what is wrong with them."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, field

import numpy as np

logger = logging.getLogger("warpmpc")


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
