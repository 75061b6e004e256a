# SPDX-License-Identifier: Apache-2.0
"""An arm that follows what moves: how closely, without touching anything, and never stuck at what it cannot reach.

Slow ones by hand: pytest -m slow tests/scenes/test_track.py
"""

import pytest
from studies.arms.track import run

pytestmark = pytest.mark.slow

SEEDS = (40, 41)
ONE_THREAD = ("engine.threads=1",)


def runs(scene: str) -> list[dict]:
    return [run(scene, seed, ONE_THREAD, None) for seed in SEEDS]


@pytest.mark.parametrize(
    ("scene", "median", "p95"),
    [
        ("storm_track", 0.018, 0.035),
        ("storm_track:raw", 0.05, 0.08),
        ("storm_track:crossing", 0.025, 0.15),
        ("storm_hold_orientation", 0.03, 0.06),
    ],
)
def test_the_hand_stays_near_the_ball_and_nothing_is_touched(scene, median, p95):
    for record in runs(scene):
        assert record["error_m"][0] < median
        assert record["error_m"][1] < p95
        assert record["force_N"] == 0.0
        assert not record["own_links"]
        if record["oriented"]:
            assert record["rotation_percent"][0] < 1.0
            assert record["rotation_percent"][1] < 3.0


def test_thin_walls_are_not_touched_and_the_arm_comes_back_from_what_it_cannot_reach():
    for record in runs("storm_track:walls"):
        assert record["force_N"] == 0.0
        assert record["clearance_m"] > 0.0
        assert all(stop["back_s"] is not None and stop["back_s"] < 3.0 for stop in record["stops"])
        for stop in record["stops"][-2:]:  # below the table, out of reach
            assert stop["came_m"] < stop["nearest_m"] + 0.04


def test_the_hand_comes_as_near_as_it_can_to_what_it_cannot_reach_and_comes_back():
    for record in runs("storm_track:beyond"):
        assert record["force_N"] == 0.0
        assert not record["own_links"]
        assert record["clearance_m"] > 0.0
        stops = record["stops"]
        assert len(stops) == 7
        for away in stops[::2]:  # too high, too far, below the table, in a block
            assert away["nearest_m"] > 0.05
            assert away["came_m"] < away["nearest_m"] + 0.03
            assert away["back_s"] is not None
            assert away["back_s"] < 2.0  # which the ball itself takes to come back
        for at_home in stops[1::2]:
            assert at_home["came_m"] < 0.02
