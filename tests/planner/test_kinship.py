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


def test_icem_is_the_cross_entropy_method_with_what_its_paper_adds():
    icem = Planner.model_validate({"method": "icem"})
    assert (icem.iterations, icem.elites, icem.keep_best, icem.decay, icem.step_size) == (3, 10, 3, 1.25, 0.9)
    assert (icem.try_mean, icem.execute, icem.noise.shape, icem.covariance.restart) == (
        "last",
        "best",
        "coloured",
        True,
    )
    own = Planner.model_validate({"method": "icem", "iterations": 2, "noise": {"exponent": 3.0}, "covariance": {}})
    assert (own.iterations, own.noise.exponent, own.noise.shape, own.covariance.form) == (2, 3.0, "coloured", "knots")
    settings = {
        **{"iterations": 3, "elites": 10, "keep_best": 3, "decay": 1.25, "step_size": 0.9, "try_mean": "last"},
        **{"execute": "best", "covariance": {"form": "knots", "restart": True}},
        "noise": {"shape": "coloured", "exponent": 2.0, "null_sample": False, "sigma": (0.5,)},
    }
    preset, spelled = (
        Planning(planner={"method": method, **more})
        for method, more in (("icem", {"noise": {"sigma": (0.5,)}}), ("cem", settings))
    )
    np.testing.assert_array_equal(preset(5), spelled(5))


def test_icem_stripped_of_its_parts_is_the_cross_entropy_method():
    plain = {"iterations": 3, "noise": {**NOISE, "shape": "identity", "null_sample": True}}
    bare = {"keep_best": False, "decay": 1.0, "step_size": 1.0, "try_mean": "always", "execute": "mean"}
    bare |= {"elites": 8, "covariance": {"restart": False}}
    cem, icem = (Planning(planner={**plain, **more}) for more in ({"method": "cem"}, {"method": "icem", **bare}))
    np.testing.assert_array_equal(cem(6), icem(6))


def test_one_elite_kept_is_the_best_sample_kept():
    settings = {"method": "cem", "iterations": 2, "noise": NOISE}
    flag, number = (Planning(planner={**settings, "keep_best": keep}) for keep in (True, 1))
    np.testing.assert_array_equal(flag(5), number(5))
