# SPDX-License-Identifier: Apache-2.0
"""Strategies that the literature says are the same, and presets that are settings of others, command for command."""

import numpy as np
import pytest
from planning import Planning

from warpmpc.scene.schema import Planner

NOISE = {"source": "random", "sigma": (0.5,), "redraw": True}
# no two samples cost the same: mppi would average ties, of which the others take the first
COST = [{"term": "distance", "between": ["base/centre", "goal"]}, {"term": "control_rate", "weight": 0.05}]
KIN = {
    "predictive sampling": {"method": "predictive_sampling"},
    "mppi, cold": {"method": "mppi", "temperature": {"initial": 1e-9, "eta": None}},
    "cem, one elite": {"method": "cem", "elites": 1, "covariance": {"form": "fixed"}},
    "tsallis, one elite": {"method": "tsallis", "elites": 1},
}


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("name", [name for name in KIN if name != "predictive sampling"])
def test_predictive_sampling_is_its_kin_command_for_command(name, seed):
    settings = {"noise": NOISE, "spline": "cubic", "knots": 4}
    plain, kin = (Planning(planner={**settings, **KIN[n]}, cost=COST, seed=seed) for n in ("predictive sampling", name))
    commands = plain(25)
    np.testing.assert_array_equal(commands, kin(25))
    np.testing.assert_array_equal(plain.mean, kin.mean)
    assert np.abs(np.diff(commands, axis=0)).max() > 0.01  # it did plan


def test_kinship_ends_where_more_than_the_best_counts():
    plain, warm = (Planning(planner={"noise": NOISE, **p}) for p in (KIN["predictive sampling"], {"method": "mppi"}))
    assert not np.array_equal(plain(5), warm(5))


def test_dial_is_annealed_mppi_and_what_a_scene_says_comes_first():
    dial = Planner.model_validate({"method": "dial"})
    assert (dial.iterations, dial.noise.shape, dial.noise.anneal) == (4, "identity", (0.5, 2.0))
    own = Planner.model_validate({"method": "dial", "iterations": 2, "noise": {"shape": "bspline"}})
    assert (own.iterations, own.noise.shape, own.noise.anneal) == (2, "bspline", (0.5, 2.0))
    same = {"iterations": 4, "noise": {"shape": "identity", "anneal": (0.5, 2.0)}}
    preset, spelled = Planning(planner={"method": "dial"}), Planning(planner={"method": "mppi", **same})
    np.testing.assert_array_equal(preset(5), spelled(5))
