# SPDX-License-Identifier: Apache-2.0
"""Rates and means with their 95 % intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Estimate:
    """A rate, or a mean, with its interval; ``low`` and ``high`` are None where one run tells none."""

    value: float
    low: float | None
    high: float | None
    count: int


def rate(successes: int, count: int) -> Estimate:
    """A rate with its Wilson score interval."""
    interval = stats.binomtest(successes, count).proportion_ci(CONFIDENCE, method="wilson")
    return Estimate(successes / count, float(interval.low), float(interval.high), count)


def mean(values: Sequence[float]) -> Estimate:
    """A mean with Student's t interval."""
    middle, count = float(np.mean(values)), len(values)
    if count < 2:
        return Estimate(middle, None, None, count)
    half = float(stats.t.ppf(0.5 + CONFIDENCE / 2, count - 1) * stats.sem(values))
    return Estimate(middle, middle - half, middle + half, count)
