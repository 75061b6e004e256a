# SPDX-License-Identifier: Apache-2.0
"""Series of numbers in memory that does not grow."""

import numpy as np

from warpmpc.loop.realtime import pace
from warpmpc.loop.realtime.pace import NewestNumbers, percentiles


def test_the_newest_numbers_are_kept_in_their_order(monkeypatch):
    monkeypatch.setattr(pace, "LONGEST", 5)
    numbers = NewestNumbers()
    assert (numbers.last, len(numbers.values())) == (0.0, 0)
    for count in range(1, 13):
        numbers.append(float(count))
        assert numbers.last == count
        assert numbers.values().tolist() == list(range(max(1, count - 4), count + 1))
    assert percentiles(numbers.values())["max"] == 12.0
    assert np.isnan(percentiles([])["p99"])
