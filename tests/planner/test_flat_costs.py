# SPDX-License-Identifier: Apache-2.0
"""A plan stands still where all samples cost the same, whatever the limits of its controls."""

import numpy as np
import pytest
from planning import Planning
from small_scenes import DISC

SPREAD = {"spread": (0.02, 1.0)}
STRATEGIES = {
    "mppi": {},
    "mppi ess": {"temperature": {"ess": 4.0}, "iterations": 2},
    "noise drawn once": {"noise": {"redraw": False}},
    "few samples": {"samples": 12},
    "diagonal": {"covariance": {"form": "diagonal"}},
    "full": {"covariance": {"form": "full"}},
    "best tried again": {"keep_best": True},
    "predictive_sampling": {"method": "predictive_sampling"},
    "cem": {"method": "cem", "noise": SPREAD},
    "icem": {"method": "icem", "noise": SPREAD},
    "dial": {"method": "dial"},
    "tsallis": {"method": "tsallis", "noise": SPREAD},
}
LIMITS = {
    "at a lower limit": (0.0, 2.0, 0.0),
    "at an upper limit": (-2.0, 0.0, 0.0),
    "one near": (-0.2, 2.0, 0.0),
    "two near": (-0.3, 0.4, 0.25),
}
"""Limits of the controls and where the plan begins."""


def moved(name: str, lower: float, upper: float, start: float, *, seed: int, plans: int = 30) -> float:
    """The farthest that a number of the mean moves in some plans whose samples all cost the same."""
    drive = {"damping": 300.0, "effort_limit": 200.0, "lower": (lower,) * 3, "upper": (upper,) * 3}
    keys = STRATEGIES[name]
    noise = {"sigma": (0.5,), "redraw": True, "null_sample": False, **keys.get("noise", {})}
    planner = {"horizon": 5, **keys, "noise": noise}
    planning = Planning(planner=planner, robot=[{**DISC, "drive": drive}], seed=seed)
    strategy, samples = planning.strategy, len(planning.knots[0])
    strategy.reset(np.full(planning.mean.shape[1:], start, dtype=np.float32))
    for _ in range(plans):
        strategy.shift()
        for i in range(len(strategy.population)):
            strategy.advance(i)
            strategy.sample_knots(i, 0, samples)
            planning.engine.cost.fill_(3.0)
            strategy.update(i)
    return np.abs(strategy.distribution.mean.numpy()[0] - start).max()


@pytest.mark.parametrize("name", STRATEGIES)
def test_no_limit_moves_a_plan_whose_samples_all_cost_the_same(name):
    for where, limits in LIMITS.items():
        for seed in range(3):
            far = moved(name, *limits, seed=seed)
            assert far < 0.1, (where, seed)  # clipped samples moved it by 0.3 to 1.5
