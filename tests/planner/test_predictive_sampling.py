# SPDX-License-Identifier: Apache-2.0
"""Predictive sampling by its name: Alg. 4 of Howell et al. (2212.00541), beside 20 lines of NumPy."""

import numpy as np
import pytest
from planning import Planning

from warpmpc.scene.schema import Planner

PLANNER = {"method": "predictive_sampling", "samples": 10, "horizon": "auto", "lookahead": 0.48, "dt": 0.04, "knots": 4}
PLANNER["noise"] = {"sigma": 0.5}
COST = [{"term": "distance", "between": ["base/centre", "goal"]}, {"term": "control_rate", "weight": 0.05}]


def cubic(times, knots, t):
    """Cubic Hermite spline through knots ``[P, nu]`` (Eqs. 17 to 23), its ends held."""
    slope = np.diff(knots, axis=0) / np.diff(times)[:, None]
    phi = np.concatenate([slope[:1], 0.5 * (slope[1:] + slope[:-1]), slope[-1:]])
    t = np.clip(t, times[0], times[-1])
    j = min(np.searchsorted(times, t, side="right") - 1, len(times) - 2)
    h = times[j + 1] - times[j]
    q = (t - times[j]) / h
    a, b, c, d = 2 * q**3 - 3 * q**2 + 1, (q**3 - 2 * q**2 + q) * h, -2 * q**3 + 3 * q**2, (q**3 - q**2) * h
    return a * knots[j] + b * phi[j] + c * knots[j + 1] + d * phi[j + 1]


def algorithm_4(times, nominal, elapsed, normals, sigma, limits, cost):
    """One plan: the nominal moved on by the time that passed, noisy copies of it, the best; returns it and its control.

    Args:
        normals: Standard normals of all candidates ``[N, P, nu]``; the first candidate is the nominal.
        cost: Costs of candidates ``[N]``.
    """
    moved = np.array([cubic(times, nominal, t + elapsed) for t in times])
    candidates = np.clip(moved + sigma * np.concatenate([np.zeros_like(normals[:1]), normals[1:]]), *limits)
    best = candidates[np.argmin(cost(candidates))]
    return best, cubic(times, best, times[0])


@pytest.mark.parametrize("seed", range(3))
def test_it_is_algorithm_4_command_for_command(seed):
    planning = Planning(planner=PLANNER, cost=COST, seed=seed)
    strategy = planning.strategy
    times, limits = planning.plan.spline.time.numpy(), (planning.layout.control_lower, planning.layout.control_upper)
    planning.elapsed, nominal = 0.0, np.zeros_like(planning.mean[0])

    def cost(candidates):
        np.testing.assert_allclose(planning.knots[0], candidates, atol=2e-6)  # what the engine rolled out
        return planning.cost[0]

    drawn = []
    for _ in range(20):
        command = planning()[0, 0]
        drawn.append(strategy.noise.z.numpy()[0].copy())
        nominal, wanted = algorithm_4(times, nominal, planning.elapsed, drawn[-1], 0.5, limits, cost)
        np.testing.assert_allclose(command, wanted, atol=1e-5)
        np.testing.assert_allclose(planning.mean[0], nominal, atol=1e-5)
        planning.elapsed = 0.04
    assert np.abs(nominal).max() > 0.1  # it did plan
    normals = np.array(drawn)[:, 1:]
    assert abs(normals.std() - 1.0) < 0.05
    flat = normals.transpose(2, 0, 1, 3).reshape(normals.shape[2], -1)
    assert np.abs(np.corrcoef(flat) - np.eye(len(flat))).max() < 0.2, "knots are independent"
    assert np.abs(np.corrcoef(normals[:-1].ravel(), normals[1:].ravel())[0, 1]) < 0.1, "drawn anew at every plan"


def test_what_a_scene_says_comes_first():
    plain = Planner.model_validate({"method": "predictive_sampling"})
    assert (plain.iterations, plain.noise.source, plain.noise.spread) == (1, "random", (1.0, 1.0))
    assert (plain.noise.constant, plain.noise.null_sample, plain.noise.shape) == (0.0, False, "identity")
    own = Planner.model_validate({"method": "predictive_sampling", "iterations": 2, "noise": {"source": "halton"}})
    assert (own.iterations, own.noise.source, own.noise.spread) == (2, "halton", (1.0, 1.0))
