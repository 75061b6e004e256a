# SPDX-License-Identifier: Apache-2.0
"""Differences of two engines over the same seeds."""

import numpy as np
import pytest
from scipy import stats
from studies.same_seeds import compared, mean_difference, rate_difference


def episode(success, time):
    return {"success": success, "time_to_goal_s": time if success else None, "plan_ms": {"p50": 1.0}}


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


def test_times_are_compared_over_seeds_that_both_reached():
    first = [episode(True, 2.0), episode(True, 3.0), episode(False, 9.0), episode(True, 5.0)]
    second = [episode(True, 1.0), episode(True, 1.0), episode(True, 1.0), episode(False, 1.0)]
    found = compared(first, second)
    assert found["success"] == [3, 3]
    assert found["time_difference_s"][0] == pytest.approx(1.5)
    assert found["time_s"] == pytest.approx([10.0 / 3.0, 1.0])
