# SPDX-License-Identifier: Apache-2.0
"""Weighted moments of the samples against float64 references, by blocks and by sweeps alike."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from planning import limited_mean

from warpmpc.kernels.planner.moments import spread_kernel, update_mean_kernel
from warpmpc.planner.covariance import SampleMoments

INF = np.inf


def moments_of(knots, weight, *, full: bool = False, device: str) -> SampleMoments:
    """Moments of knots [E, S, P, nu] with weights [E, S]."""
    arrays = (wp.array(np.asarray(a), dtype=float, device=device) for a in (knots, weight))
    return SampleMoments(*arrays, full=full)


def updated_mean(knots, weight, mean, *, alpha: float, device: str) -> np.ndarray:
    """The mean [E, P, nu] after one update."""
    out = wp.array(mean, dtype=float, device=device)
    moments_of(knots, weight, device=device).move_mean(out, alpha)
    return out.numpy()


def some_samples(seed: int, samples: int = 300) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Knots [2, S, 5, 3], weights [2, S] of which some are zero, and a mean [2, 5, 3]."""
    rng = np.random.default_rng(seed)
    weight = rng.uniform(size=(2, samples))
    weight[:, 1:][rng.uniform(size=(2, samples - 1)) < 0.3] = 0.0
    return rng.normal(size=(2, samples, 5, 3)), weight / weight.sum(axis=1, keepdims=True), rng.normal(size=(2, 5, 3))


@pytest.mark.parametrize("alpha", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("samples", [1, 300])
def test_the_mean_matches_the_reference(alpha, samples, device):
    knots, weight, mean = some_samples(samples, samples)
    expected = (1.0 - alpha) * mean + alpha * np.einsum("es,espu->epu", weight, knots)
    new_mean = updated_mean(knots, weight, mean, alpha=alpha, device=device)
    np.testing.assert_allclose(new_mean, expected, rtol=1e-4, atol=1e-5)


@given(seed=st.integers(0, 2**31 - 1), fixed=st.integers(0, 4), tried=st.integers(6, 60), wide=st.floats(0.5, 5.0))
def test_the_mean_of_samples_that_met_limits_matches_the_reference(seed, fixed, tried, wide, device):
    drawn, weight, mean = some_samples(seed, 60)
    weight[:, tried:] = 0.0  # a cost of +inf
    limits, alpha = (np.array([-wide, -9.0, -0.1]), np.array([wide, 9.0, 0.2])), 0.7
    columns = [wp.array(np.tile(limit, 5), dtype=float, device=device) for limit in limits]
    variance = np.random.default_rng(seed).uniform(size=60)
    variance[1 : fixed + 1] = 0.0
    arrays = (wp.array(a, dtype=float, device=device) for a in (drawn, weight))
    out = wp.array(mean, dtype=float, device=device)
    moments = SampleMoments(*arrays, limits=columns, variance=wp.array(variance, dtype=float, device=device))
    moments.move_mean(out, alpha, tried=tried)
    expected = limited_mean(drawn, weight, mean, limits, alpha=alpha, variance=variance[:tried])
    np.testing.assert_allclose(out.numpy(), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("samples", [1, 300])
def test_the_spread_matches_the_reference(samples, full, device):
    knots, weight, mean = some_samples(samples, samples)
    moments = moments_of(knots, 3.0 * weight, full=full, device=device)
    moments.spread_about(wp.array(mean, dtype=float, device=device))
    products = moments.products.numpy().reshape(2, 3 if full else 1, 5, 3)
    deviation = knots - mean[:, None]
    for lag in range(products.shape[1]):
        ahead = deviation[..., lag:]
        expected = 3.0 * np.einsum("es,espu,espu->epu", weight, deviation[..., : 3 - lag], ahead)
        np.testing.assert_allclose(products[:, lag, :, : 3 - lag], expected, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(moments.total.numpy(), 3.0, rtol=1e-5)


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_a_sweep_on_the_cpu_adds_up_the_bits_that_blocks_do(seed, full):
    knots, weight, mean = some_samples(seed)
    bounds = [wp.full(15, bound, dtype=float, device="cpu") for bound in (-0.9, 2.9)]
    variance = wp.array([*range(300)], dtype=float, device="cpu")
    arrays = (wp.array(a, dtype=float, device="cpu") for a in (knots, weight))
    moments = SampleMoments(*arrays, limits=bounds, variance=variance, full=full)
    swept, blocks = (wp.array(mean, dtype=float, device="cpu") for _ in range(2))
    moments.move_mean(swept, 0.3, tried=290)
    flat = [wp.array(a.reshape(*a.shape[:-2], 15), dtype=float, device="cpu") for a in (knots, mean)]
    weight = wp.array(weight, dtype=float, device="cpu")
    wp.launch_tiled(
        update_mean_kernel,
        dim=[2, 15],
        inputs=[flat[0], weight, variance, 290, *bounds, 0.3],
        outputs=[blocks.reshape((2, 15))],
        block_dim=256,
        device="cpu",
    )
    np.testing.assert_array_equal(swept.numpy(), blocks.numpy())

    moments.spread_about(wp.array(mean, dtype=float, device="cpu"))
    products, total = wp.zeros_like(moments.products), wp.zeros_like(moments.total)
    wp.launch_tiled(
        spread_kernel,
        dim=list(products.shape),
        inputs=[flat[0], weight, flat[1]],
        outputs=[products, total],
        block_dim=256,
        device="cpu",
    )
    for lag in range(products.shape[1]):
        read = np.s_[:, lag, : 15 - lag]  # what comes after it has no control so much later
        np.testing.assert_array_equal(moments.products.numpy()[read], products.numpy()[read])
    np.testing.assert_array_equal(moments.total.numpy(), total.numpy())


def test_the_mean_stays_where_it_is_without_weights(device):
    mean, knots, weight = np.full((2, 3, 1), 5.0), np.ones((2, 4, 3, 1)), np.zeros((2, 4))
    weight[1] = 0.25
    np.testing.assert_array_equal(updated_mean(knots, weight, mean, alpha=1.0, device=device)[:, 0, 0], [5.0, 1.0])


def test_weights_need_not_be_normalized(device):
    knots = np.random.default_rng(2).normal(size=(1, 6, 2, 2))
    weight = np.random.default_rng(3).uniform(size=(1, 6))
    mean = np.zeros((1, 2, 2))
    np.testing.assert_allclose(
        updated_mean(knots, 7.0 * weight, mean, alpha=1.0, device=device),
        np.average(knots[0], axis=0, weights=weight[0])[None],
        rtol=1e-4,
        atol=1e-6,
    )


@given(seed=st.integers(0, 2**31 - 1), alpha=st.floats(0.0, 1.0))
def test_the_new_mean_is_within_the_samples_it_came_from(seed, alpha, device):
    rng = np.random.default_rng(seed)
    knots, mean = rng.normal(size=(1, 10, 3, 2)), rng.normal(size=(1, 3, 2))
    new = updated_mean(knots, rng.uniform(size=(1, 10)), mean, alpha=alpha, device=device)
    assert np.all(new <= np.maximum(knots.max(axis=1), mean) + 1e-5)
    assert np.all(new >= np.minimum(knots.min(axis=1), mean) - 1e-5)


def test_the_best_sample_is_kept_until_a_better_one_is_finite(device):
    knots, weight, _ = some_samples(0, 6)
    moments = moments_of(knots, weight, device=device)
    best = wp.full((1, 2, 5, 3), 9.0, dtype=float, device=device)
    for cost, expected in (
        ([[INF] * 6, [3.0, 2.0, 2.0, INF, np.nan, 2.5]], [np.full((5, 3), 9.0), knots[1, 1]]),
        ([[1.0, -INF, 0.5, 2.0, 2.0, 2.0], [INF] * 6], [knots[0, 2], knots[1, 1]]),
    ):
        moments.keep_best(wp.array(cost, dtype=float, device=device), best)
        np.testing.assert_array_equal(best.numpy()[0], np.asarray(expected, dtype=np.float32))


def test_several_of_the_best_are_kept_in_order_the_first_of_equals_first(device):
    knots, weight, _ = some_samples(0, 6)
    moments = moments_of(knots, weight, device=device)
    best = wp.full((3, 2, 5, 3), 9.0, dtype=float, device=device)
    cost = [[2.0, 1.0, INF, 1.0, 0.5, 1.0], [INF, 3.0, np.nan, INF, 2.0, INF]]
    moments.keep_best(wp.array(cost, dtype=float, device=device), best)
    np.testing.assert_array_equal(best.numpy()[:, 0], knots[0, [4, 1, 3]].astype(np.float32))
    np.testing.assert_array_equal(best.numpy()[:2, 1], knots[1, [4, 1]].astype(np.float32))
    assert np.all(best.numpy()[2, 1] == 9.0)  # no third one is finite
