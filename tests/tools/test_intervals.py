# SPDX-License-Identifier: Apache-2.0
"""Intervals of rates, means and paired differences."""

import numpy as np
import pytest
from scipy import stats
from shared.intervals import mean, mean_difference, rate, rate_difference


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


def test_what_both_do_alike_differs_by_nothing_but_is_not_certain():
    every = np.ones(16, dtype=bool)
    lead, low, high = rate_difference(every, every)
    assert lead == 0.0
    assert -0.25 < low < 0.0 < high < 0.25


def test_an_interval_of_rates_covers_the_true_difference_as_often_as_it_says():
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(400):
        shared = rng.random(32) < 0.6
        first, second = shared | (rng.random(32) < 0.5), shared | (rng.random(32) < 0.25)
        _, low, high = rate_difference(first, second)
        hits += low <= 0.4 * 0.25 <= high
    assert hits / 400 >= 0.92


def test_an_interval_of_times_is_that_of_a_paired_test():
    values = np.random.default_rng(1).normal(0.3, 1.0, 12)
    mean, low, high = mean_difference(values)
    expected = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    assert (mean, low, high) == pytest.approx((values.mean(), expected.low, expected.high))
    assert mean_difference(values[:1]) is None
