# SPDX-License-Identifier: Apache-2.0
"""A planar robot among posts in closed loop: what samples are drawn from decides how smooth its commands are.

Slow ones by hand: pytest -m slow tests/scenes/test_storm_sampling.py
"""

import numpy as np
import pytest
from shared.measure import Meter

import warpmpc
from warpmpc.loop.run.episode import Episode

SHAPES = ("comb", "bspline")


@pytest.mark.slow
def test_splines_ask_for_smoother_motions_than_combs():
    rates, reached = {}, 0
    for shape in SHAPES:
        scene = warpmpc.load_scene("holonomic_2d", overrides=[f"planner.noise.shape={shape}"])
        for seed in range(60, 68):
            episode = Episode(scene, seed=seed)
            meter = Meter(episode.plant)
            result = episode.run(on_step=meter)
            assert result.max_force == 0.0, result
            reached += result.success
            rates[shape, seed] = meter.squared_control_rate
    assert reached >= 14
    comb, bspline = (np.median([rates[shape, seed] for seed in range(60, 68)]) for shape in SHAPES)
    assert bspline < 0.5 * comb


def test_a_disc_finds_its_way_among_posts():
    result = warpmpc.run_episode(warpmpc.load_scene("holonomic_2d"), seed=60)
    assert result.success, result
    assert result.max_force == 0.0, result
    assert result.sim_time < 8.0
