# SPDX-License-Identifier: Apache-2.0
"""Differences of two engines over the same seeds."""

import pytest
from studies.same_seeds import compared


def episode(success, time):
    return {"success": success, "time_to_goal_s": time if success else None, "plan_ms": {"p50": 1.0}}


def test_times_are_compared_over_seeds_that_both_reached():
    first = [episode(True, 2.0), episode(True, 3.0), episode(False, 9.0), episode(True, 5.0)]
    second = [episode(True, 1.0), episode(True, 1.0), episode(True, 1.0), episode(False, 1.0)]
    found = compared(first, second)
    assert found["success"] == [3, 3]
    assert found["time_difference_s"][0] == pytest.approx(1.5)
    assert found["time_s"] == pytest.approx([10.0 / 3.0, 1.0])
