# SPDX-License-Identifier: Apache-2.0
"""Rates, means and paired differences with their 95 % intervals."""

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


def rate_difference(first: np.ndarray, second: np.ndarray) -> tuple[float, float, float]:
    """Difference of two paired rates and its interval: one is added to either kind of disagreement."""
    n = len(first)
    more, less = ((first & ~second).sum() + 1) / (n + 2), ((second & ~first).sum() + 1) / (n + 2)
    half = stats.norm.ppf(0.5 + CONFIDENCE / 2) * np.sqrt((more + less - (more - less) ** 2) / (n + 2))
    return (
        float(first.mean() - second.mean()),
        max(-1.0, float(more - less - half)),
        min(1.0, float(more - less + half)),
    )


def mean_difference(values: np.ndarray) -> tuple[float, float, float] | None:
    """Mean of paired differences and its interval, None with less than two of them."""
    if len(values) < 2:
        return None
    half = stats.t.ppf(0.5 + CONFIDENCE / 2, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values))
    return float(values.mean()), float(values.mean() - half), float(values.mean() + half)
