# SPDX-License-Identifier: Apache-2.0
"""Late measurements and such that come out of order."""

import numpy as np
import pytest

from warpmpc.loop.estimation.measurement import KEPT, History, PoseMeasured
from warpmpc.loop.estimation.scene_estimator import PoseFilter
from warpmpc.scene.schema_estimate import Estimate


def measurements(seed, count=60):
    """Measured poses at 30 Hz with an outlier here and there."""
    rng = np.random.default_rng(seed)
    for k in range(count):
        place = [np.sin(0.05 * k), 0.02 * k, 0.0] + rng.normal(0.0, 0.01, 3) + 0.5 * (rng.random() < 0.1)
        rotation = np.r_[rng.normal(0.0, 0.02, 3), 1.0]
        yield PoseMeasured("box", k / 30, np.r_[place, rotation])


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("model", ["constant_velocity", "constant_acceleration"])
def test_late_measurements_are_as_good_as_ones_in_order(model, seed):
    rng, rows = np.random.default_rng(100 + seed), list(measurements(seed))
    in_order, late = (History(PoseFilter(Estimate(model=model))) for _ in range(2))
    for row in rows:
        in_order.insert(row)
    for i in np.argsort([row.time + rng.uniform(0.0, 0.3) for row in rows]):
        late.insert(rows[i])
    assert late.too_late == 0
    for time in (1.5, 1.9, 2.0, 2.1):
        ours, theirs = late.at(time), in_order.at(time)
        for name in ("position", "rotation", "linear", "angular", "covariance"):
            np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))


def test_what_is_older_than_the_buffer_is_counted_and_left_out():
    history = History(PoseFilter(Estimate()))
    for row in measurements(0):
        history.insert(row)
    before = history.at(2.0)
    history.insert(PoseMeasured("box", 2.0 - 2.0 * KEPT, np.array([5.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])))
    assert history.too_late == 1
    np.testing.assert_array_equal(history.at(2.0).position, before.position)
    assert len(history._measured) <= 30 * KEPT + 2


def test_a_measurement_that_comes_again_counts_once():
    once, twice, rows = History(PoseFilter(Estimate())), History(PoseFilter(Estimate())), list(measurements(2))
    for k, row in enumerate(rows):
        once.insert(row)
        for again in (row, rows[max(k - 3, 0)]):
            twice.insert(again)
    np.testing.assert_array_equal(twice.at(2.0).position, once.at(2.0).position)
    np.testing.assert_array_equal(twice.at(2.0).covariance, once.at(2.0).covariance)


def test_the_past_is_told_from_what_was_measured_until_then():
    history, rows = History(PoseFilter(Estimate())), list(measurements(1))
    known = []
    for row in rows:
        history.insert(row)
        known.append(history.at(row.time).position)
    for k in (40, 45, 59):
        np.testing.assert_array_equal(history.at(rows[k].time).position, known[k])
    assert History(PoseFilter(Estimate())).at(0.0) is None
