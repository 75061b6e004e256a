# SPDX-License-Identifier: Apache-2.0
"""A ball on a tray in closed loop, in physics with friction, seen late and with noise.

Slow ones by hand: pytest -m slow tests/scenes/test_storm_balance.py
"""

from argparse import Namespace

import numpy as np
import pytest
from studies.arms.balance import balance

SEEN = Namespace(time=7.0, rate=30.0, noise=0.005)


def test_a_ball_comes_to_the_centre_and_stays_there():
    run = balance("storm_balance", 50, [], SEEN)
    assert run.distance[0] > 0.05
    assert run.distance[200:].max() < 0.02


@pytest.mark.slow
def test_balls_stay_near_the_centre():
    runs = [balance("storm_balance", seed, [], SEEN) for seed in range(51, 59)]
    assert sum(run.distance[200:].max() < 0.02 for run in runs) >= 7
    assert all(run.distance[200:].max() < 0.04 for run in runs)


@pytest.mark.slow
def test_balls_stay_on_a_tray_that_goes_from_place_to_place():
    seen = Namespace(**{**vars(SEEN), "time": 13.0})
    runs = [balance("storm_balance:moving", seed, [], seen) for seed in range(60, 64)]
    assert all(run.distance[200:].max() < 0.04 for run in runs)
    assert np.median([np.median(run.hand) for run in runs]) < 0.1
