# SPDX-License-Identifier: Apache-2.0
"""Intervals of rates and means."""

import pytest
from shared.intervals import mean, rate


@pytest.mark.parametrize(
    ("successes", "count", "low", "high"),
    [(8, 10, 0.4901625, 0.9433178), (0, 10, 0.0, 0.2775328), (100, 100, 0.9630065, 1.0), (1, 2, 0.0945312, 0.9054688)],
)
def test_wilson_intervals(successes, count, low, high):
    found = rate(successes, count)
    assert (found.low, found.high) == (pytest.approx(low, abs=1e-6), pytest.approx(high, abs=1e-6))


def test_student_intervals():
    found = mean([1.0, 2.0, 3.0])
    assert (found.value, found.high - 2.0) == (2.0, pytest.approx(2.4841377))  # 4.302653 / √3
    assert mean([4.0]).low is None
