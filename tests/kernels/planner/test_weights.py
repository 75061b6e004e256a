# SPDX-License-Identifier: Apache-2.0
"""Costs of samples to weights against float64 references, and what a diverged world may not do."""

import numpy as np
import pytest
import scipy.optimize
import warp as wp
from hypothesis import given
from hypothesis import strategies as st

from warpmpc.kernels.planner.weights import (
    best_weight_kernel,
    bisect_temperature_kernel,
    elite_weight_kernel,
    importance_weight_kernel,
)

INF = np.inf


def on(device: str, array, dtype=float) -> wp.array:
    """Copy of an array-like on the device."""
    return wp.array(np.asarray(array), dtype=dtype, device=device)


def weigh(cost, *, beta=1.0, adapt=True, eta_bounds=(5.0, 10.0), beta_bounds=(1e-4, 1e6), device: str):
    """Importance weights [E, S], η [E] and the adapted β [E] of costs [E, S]."""
    cost = np.asarray(cost, dtype=np.float32)
    weight = wp.empty(cost.shape, dtype=float, device=device)
    eta = wp.empty(len(cost), dtype=float, device=device)
    beta = wp.full(len(cost), beta, dtype=float, device=device)
    wp.launch_tiled(
        importance_weight_kernel,
        dim=[len(cost)],
        inputs=[on(device, cost), wp.vec2(*eta_bounds), wp.vec2(*beta_bounds), int(adapt)],
        outputs=[beta, eta, weight],
        block_dim=256,
        device=device,
    )
    return weight.numpy(), eta.numpy(), beta.numpy()


def bisected(cost, *, target: float, beta=1.0, beta_bounds=(1e-4, 1e6), device: str) -> np.ndarray:
    """Temperatures β [E] that give costs [E, S] this effective sample size."""
    cost = np.asarray(cost, dtype=np.float32)
    out = wp.full(len(cost), beta, dtype=float, device=device)
    wp.launch_tiled(
        bisect_temperature_kernel,
        dim=[len(cost)],
        inputs=[on(device, cost), target, wp.vec2(*beta_bounds)],
        outputs=[out],
        block_dim=256,
        device=device,
    )
    return out.numpy()


def best(cost, *, device: str):
    """Predictive sampling's weights [E, S] and η [E]."""
    cost = np.asarray(cost, dtype=np.float32)
    weight = wp.empty(cost.shape, dtype=float, device=device)
    eta = wp.empty(len(cost), dtype=float, device=device)
    wp.launch_tiled(
        best_weight_kernel,
        dim=[len(cost)],
        inputs=[on(device, cost)],
        outputs=[eta, weight],
        block_dim=256,
        device=device,
    )
    return weight.numpy(), eta.numpy()


def elite(cost, *, elites: int, device: str):
    """Elite weights [E, S] and η [E]."""
    cost = np.asarray(cost, dtype=np.float32)
    weight = wp.empty(cost.shape, dtype=float, device=device)
    eta = wp.empty(len(cost), dtype=float, device=device)
    wp.launch_tiled(
        elite_weight_kernel,
        dim=[len(cost)],
        inputs=[on(device, cost), elites],
        outputs=[eta, weight],
        block_dim=256,
        device=device,
    )
    return weight.numpy(), eta.numpy()


def reference_weights(cost: np.ndarray, beta: float) -> np.ndarray:
    """Importance weights [S] of float64 costs [S]."""
    finite = np.isfinite(cost)
    w = np.zeros(len(cost))
    w[finite] = np.exp(-(cost[finite] - cost[finite].min()) / beta)
    return w / w.sum()


def effective_samples(cost: np.ndarray, beta: float) -> float:
    """(Σw)²/Σw² of float64 costs [S]."""
    w = reference_weights(cost, beta)
    return 1.0 / np.sum(w**2)


def some_costs(seed: int, envs: int, samples: int, *, diverged: float = 0.1) -> np.ndarray:
    """Random costs [E, S], a share of them +inf, the first never."""
    rng = np.random.default_rng(seed)
    cost = rng.gamma(2.0, 3.0, size=(envs, samples)).astype(np.float32)
    cost[:, 1:][rng.uniform(size=(envs, samples - 1)) < diverged] = INF
    return cost


ALL_WEIGHTINGS = pytest.mark.parametrize(
    "weighting",
    [
        lambda cost, device: weigh(cost, device=device)[0],
        lambda cost, device: best(cost, device=device)[0],
        lambda cost, device: elite(cost, elites=4, device=device)[0],
    ],
    ids=["importance", "best", "elite"],
)


# importance weights


@pytest.mark.parametrize("beta", [0.05, 0.7, 30.0])
@pytest.mark.parametrize("samples", [1, 3, 257, 1000])
def test_importance_weights_match_the_reference(beta, samples, device):
    cost = some_costs(samples, 3, samples)
    weight, eta, _ = weigh(cost, beta=beta, device=device)
    for e, row in enumerate(cost.astype(np.float64)):
        expected = reference_weights(row, beta)
        np.testing.assert_allclose(weight[e], expected, rtol=1e-4, atol=1e-8)
        assert eta[e] == pytest.approx(1.0 / expected.max(), rel=1e-4)  # the best has w = 1 before normalization


@ALL_WEIGHTINGS
@given(seed=st.integers(0, 2**31 - 1), samples=st.integers(1, 40))
def test_weights_sum_to_one_and_never_fall_on_a_diverged_sample(weighting, seed, samples, device):
    cost = some_costs(seed, 2, samples, diverged=0.5)
    weight = weighting(cost, device)
    np.testing.assert_allclose(weight.sum(axis=1), 1.0, rtol=1e-5)
    assert np.all(weight >= 0.0)
    assert np.all(weight[~np.isfinite(cost)] == 0.0)


@ALL_WEIGHTINGS
@given(seed=st.integers(0, 2**31 - 1), samples=st.integers(2, 40))
def test_permuted_samples_have_permuted_weights(weighting, seed, samples, device):
    cost = some_costs(seed, 1, samples)
    order = np.random.default_rng(seed).permutation(samples)
    np.testing.assert_allclose(weighting(cost[:, order], device), weighting(cost, device)[:, order], rtol=1e-5)


@ALL_WEIGHTINGS
@given(seed=st.integers(0, 2**31 - 1), offset=st.integers(-1000, 1000))
def test_a_constant_added_to_all_costs_changes_no_weight(weighting, seed, offset, device):
    # costs on a grid of 1/64, so that the sum is exact in float32
    cost = np.round(64.0 * some_costs(seed, 1, 20)) / 64.0
    np.testing.assert_array_equal(weighting(cost + offset, device), weighting(cost, device))


@ALL_WEIGHTINGS
def test_a_diverged_sample_moves_no_other(weighting, device):
    cost = some_costs(3, 1, 30, diverged=0.0)
    poisoned = np.concatenate([cost, [[INF, np.nan, -INF]]], axis=1)
    weight = weighting(poisoned, device)
    np.testing.assert_array_equal(weight[:, 30:], 0.0)
    np.testing.assert_allclose(weight[:, :30], weighting(cost, device), rtol=1e-6)


@ALL_WEIGHTINGS
def test_an_environment_whose_samples_all_diverged_has_no_weights_and_disturbs_no_neighbour(weighting, device):
    cost = some_costs(4, 3, 20)
    clean = weighting(cost, device)
    cost[1] = INF
    weight = weighting(cost, device)
    np.testing.assert_array_equal(weight[1], 0.0)
    np.testing.assert_array_equal(weight[[0, 2]], clean[[0, 2]])


@ALL_WEIGHTINGS
def test_weights_are_the_same_bits_every_time(weighting, device):
    cost = some_costs(5, 2, 777)
    np.testing.assert_array_equal(weighting(cost, device), weighting(cost, device))


def test_extreme_costs_and_temperatures_stay_finite(device):
    cost = [[-3.0e38, 3.0e38, 0.0, -3.0e38], [1e30, 1e30, 1e30, 1e30]]
    for beta in (1e-4, 1e6):
        weight, _, _ = weigh(cost, beta=beta, device=device)
        np.testing.assert_array_equal(weight, [[0.5, 0.0, 0.0, 0.5], [0.25] * 4])


# temperature


@pytest.mark.parametrize(("spread", "factor"), [(0.0, 0.9), (100.0, 1.2)])
def test_temperature_moves_towards_the_eta_bounds(spread, factor, device):
    cost = spread * np.arange(50)[None]
    assert weigh(cost, device=device)[2][0] == pytest.approx(factor)
    assert weigh(cost, adapt=False, device=device)[2][0] == 1.0


def test_temperature_rests_within_the_eta_bounds(device):
    cost = np.where(np.arange(50) < 7, 0.0, 1000.0)[None]
    _, eta, beta = weigh(cost, device=device)
    assert eta[0] == pytest.approx(7.0)
    assert beta[0] == 1.0


@pytest.mark.parametrize(("spread", "bound"), [(0.0, 0.95), (100.0, 1.1)])
def test_temperature_stays_within_its_bounds(spread, bound, device):
    cost = spread * np.arange(50)[None]
    assert weigh(cost, beta_bounds=(0.95, 1.1), device=device)[2][0] == pytest.approx(bound)


def test_an_environment_whose_samples_all_diverged_keeps_its_temperature(device):
    cost = np.full((1, 9), INF)
    _, eta, beta = weigh(cost, beta=3.0, device=device)
    assert (eta[0], beta[0]) == (0.0, 3.0)
    assert bisected(cost, target=5.0, beta=3.0, device=device)[0] == 3.0


@pytest.mark.parametrize("target", [1.5, 10.0, 100.0])
@pytest.mark.parametrize("scale", [1e-2, 1.0, 1e3])
def test_bisection_meets_the_effective_sample_size(target, scale, device):
    cost = (scale * some_costs(6, 2, 300)).astype(np.float32)
    beta = bisected(cost, target=target, device=device)
    for e, row in enumerate(cost.astype(np.float64)):
        root = scipy.optimize.brentq(lambda x, row=row: effective_samples(row, np.exp(x)) - target, -9.0, 13.0)
        assert effective_samples(row, beta[e]) == pytest.approx(target, rel=1e-3)
        assert beta[e] == pytest.approx(np.exp(root), rel=1e-3)


@pytest.mark.parametrize(("cost", "bound"), [([0.0, 1.0, 2.0], 50.0), ([0.0] * 9, 0.1)])
def test_an_unreachable_sample_size_ends_at_a_bound(cost, bound, device):
    beta = bisected([cost], target=5.0, beta_bounds=(0.1, 50.0), device=device)
    assert beta[0] == pytest.approx(bound, rel=1e-4)


# best and elites


@pytest.mark.parametrize("samples", [1, 5, 256, 1000])
def test_the_best_sample_takes_all(samples, device):
    cost = some_costs(7, 3, samples)
    weight, eta = best(cost, device=device)
    np.testing.assert_array_equal(weight, np.eye(samples)[cost.argmin(axis=1)])
    np.testing.assert_array_equal(eta, 1.0)


def test_the_first_of_equally_good_samples_wins(device):
    cost = np.ones((1, 600))
    cost[0, [300, 40, 599]] = 0.0
    assert best(cost, device=device)[0][0].nonzero()[0].tolist() == [40]
    assert elite(cost, elites=2, device=device)[0][0].nonzero()[0].tolist() == [40, 300]
    assert elite(cost, elites=5, device=device)[0][0].nonzero()[0].tolist() == [0, 1, 40, 300, 599]


def test_no_best_among_diverged_samples(device):
    weight, eta = best(np.full((1, 4), INF), device=device)
    assert (weight.sum(), eta[0]) == (0.0, 0.0)


@pytest.mark.parametrize("elites", [1, 8, 300])
def test_elites_match_a_stable_sort(elites, device):
    cost = np.round(some_costs(8, 3, 300))  # many ties
    weight, eta = elite(cost, elites=elites, device=device)
    for e, row in enumerate(cost):
        count = min(elites, np.isfinite(row).sum())
        expected = np.zeros(300, dtype=np.float32)
        expected[np.argsort(row, kind="stable")[:count]] = np.float32(1.0) / np.float32(count)
        np.testing.assert_array_equal(weight[e], expected)
        assert eta[e] == count


@given(
    costs=st.lists(
        st.floats(width=32, allow_nan=True) | st.sampled_from([-1.0, -0.0, 0.0, 1.0, INF, -INF]),
        min_size=1,
        max_size=40,
    ),
    elites=st.integers(1, 45),
)
def test_elites_are_the_first_of_all_costs_in_order(costs, elites, device):
    """Of every sign and size, equal ones, and those that are not finite: as a stable sort has them."""
    cost = np.array([costs], dtype=np.float32)
    weight, eta = elite(cost, elites=elites, device=device)
    finite = np.flatnonzero(np.isfinite(cost[0]))
    chosen = finite[np.argsort(cost[0, finite], kind="stable")][:elites]
    expected = np.zeros(len(costs))
    expected[chosen] = 1.0 / max(len(chosen), 1)
    assert eta[0] == len(chosen)
    np.testing.assert_allclose(weight[0], expected, rtol=1e-6)
