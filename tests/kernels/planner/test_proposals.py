# SPDX-License-Identifier: Apache-2.0
"""Candidate knots against a float64 reference: shaped noise about the mean, fixed rows, limits."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st

from warpmpc.kernels.planner.proposals import perturb_knots_kernel, shape_noise_kernel


def perturb(
    mean,
    sigma,
    shaping,
    z,
    *,
    lower,
    upper,
    null_sample: bool = False,
    null=None,
    fixed=(),
    mean_row: bool = True,
    factor=None,
    schedule=None,
    iteration: int = 0,
    constant: float = 0.0,
    first: int = 0,
    lanes: tuple[int, int] = (1, 1),
    device: str,
) -> np.ndarray:
    """Run the kernels on mean and σ [E, P, nu], B [P, P] and z [E, S, P, nu]; returns knots [E, S, P, nu].

    Fixed rows [F, E, P, nu] come after the null sample; ``factor`` [E, nu, nu] takes the place of σ.
    """
    envs, samples, knots, nu = z.shape
    rows = [np.repeat((np.zeros((envs, nu)) if null is None else null)[:, None], knots, axis=1)] * null_sample
    rows += list(fixed)
    schedule = np.ones((1, knots)) if schedule is None else schedule
    bands = np.zeros((envs, nu, knots, nu))
    for lag in range(nu if factor is not None else 0):
        for u in range(lag, nu):
            bands[:, lag, :, u] = factor[:, None, u, u - lag]

    def on(a, *shape: int) -> wp.array:
        return wp.array(np.reshape(a, shape) if shape else a, dtype=float, device=device)

    wide, count = knots * nu, envs * samples - first
    noise, out = on(np.zeros(z.shape), envs, samples, wide), on(np.zeros(z.shape), envs, samples, wide)
    matrix = [on(np.zeros((1, 1)) if shaping is None else shaping), int(shaping is None)]
    inputs = [on(z, envs, samples, wide), *matrix, constant, nu, first, lanes[0]]
    wp.launch(shape_noise_kernel, dim=(count, lanes[0]), inputs=inputs, outputs=[noise], device=device)
    inputs = [on(mean, envs, wide), on(sigma, envs, wide), on(bands, envs, nu, wide), int(factor is not None)]
    inputs += [on(np.repeat(schedule, nu, axis=1)), iteration, noise]
    inputs += [on(rows or np.zeros((1, envs, wide)), max(len(rows), 1), envs, wide), len(rows), int(mean_row)]
    inputs += [on(np.tile(lower, knots)), on(np.tile(upper, knots)), first, lanes[1]]
    wp.launch(
        perturb_knots_kernel, dim=(count, lanes[1]), inputs=inputs, outputs=[wp.empty_like(out), out], device=device
    )
    return out.numpy().reshape(z.shape)


@pytest.mark.parametrize("iteration", [0, 2])
def test_noise_is_scaled_by_the_schedule_of_its_iteration(iteration, device):
    case = random_knots(3, samples=20)
    schedule = np.random.default_rng(0).uniform(0.1, 2.0, size=(3, 5))
    knots = perturb(**case, null_sample=False, schedule=schedule, iteration=iteration, device=device)
    noise = np.einsum("pq,esqu->espu", case["shaping"], case["z"])
    expected = case["mean"][:, None] + schedule[iteration][:, None] * case["sigma"][:, None] * noise
    np.testing.assert_allclose(knots[:, 1:], expected[:, 1:], rtol=1e-5, atol=1e-5)


def test_the_null_sample_is_what_each_environment_asks_for_when_it_asks_for_nothing(device):
    case, null = random_knots(4, samples=5), np.array([[0.1, -0.2, 0.3], [4.0, 5.0, -6.0]])
    knots = perturb(**case, null_sample=True, null=null, device=device)
    np.testing.assert_allclose(knots[:, 1], np.repeat(null[:, None], 5, axis=1), rtol=1e-6)


@pytest.mark.parametrize("null_sample", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_knots_match_the_reference(seed, null_sample, device):
    rng = np.random.default_rng(seed)
    mean, sigma = rng.normal(size=(2, 5, 3)), rng.uniform(0.1, 1.0, size=(2, 5, 3))
    shaping, z = rng.normal(size=(5, 5)), rng.normal(size=(2, 9, 5, 3))
    lower, upper = -np.array([0.5, 1.0, 9.0]), np.array([1.0, 0.7, 9.0])
    knots = perturb(mean, sigma, shaping, z, lower=lower, upper=upper, null_sample=null_sample, device=device)

    expected = mean[:, None] + sigma[:, None] * np.einsum("pq,esqu->espu", shaping, z)
    expected[:, 0] = mean
    if null_sample:
        expected[:, 1] = 0.0
    np.testing.assert_allclose(knots, np.clip(expected, lower, upper), rtol=1e-5, atol=1e-5)


def random_knots(seed: int, *, samples: int = 200) -> dict[str, np.ndarray]:
    """Arguments of ``perturb`` with limits that no knot reaches."""
    rng = np.random.default_rng(seed)
    return {
        "mean": rng.normal(size=(2, 5, 3)),
        "sigma": rng.uniform(0.1, 1.0, size=(2, 5, 3)),
        "shaping": rng.normal(size=(5, 5)),
        "z": rng.normal(size=(2, samples, 5, 3)),
        "lower": np.full(3, -99.0),
        "upper": np.full(3, 99.0),
    }


@pytest.mark.parametrize("null_sample", [False, True])
@pytest.mark.parametrize("constant", [0.01, 0.25, 0.3, 0.5, 0.77])
def test_a_share_of_the_samples_is_perturbed_alike_at_every_knot(constant, null_sample, device):
    case = random_knots(0)
    knots = perturb(**case, null_sample=null_sample, constant=constant, device=device)
    shaped = perturb(**case, null_sample=null_sample, device=device)
    noise = (knots - case["mean"][:, None]) / case["sigma"][:, None]
    alike = np.ptp(noise, axis=2).max(axis=2) < 1e-4  # [E, S]
    np.testing.assert_array_equal(alike[0], alike[1])
    first = 2 if null_sample else 1
    np.testing.assert_array_equal(knots[:, :first], shaped[:, :first])
    chosen = np.flatnonzero(alike[0, first:]) + first
    assert abs(len(chosen) - constant * 200) <= first
    # evenly: however many samples are looked at, the share is right
    share = np.cumsum(np.isin(np.arange(200), chosen)) - constant * np.arange(1, 201)
    assert np.abs(share).max() < first + 1.0

    others = np.setdiff1d(np.arange(200), chosen)
    np.testing.assert_array_equal(knots[:, others], shaped[:, others])
    expected = case["mean"][:, None] + case["sigma"][:, None] * case["z"][:, chosen, :1]
    np.testing.assert_allclose(knots[:, chosen], expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("null_sample", [False, True])
def test_all_samples_or_none_are_constant_at_the_limits_of_the_share(null_sample, device):
    case = random_knots(1, samples=50)
    none, every = (perturb(**case, null_sample=null_sample, constant=c, device=device) for c in (0.0, 1.0))
    mean, sigma = case["mean"][:, None], case["sigma"][:, None]
    shaped = mean + sigma * np.einsum("pq,esqu->espu", case["shaping"], case["z"])
    alike = mean + sigma * case["z"][:, :, :1]
    for found, expected in ((none, shaped), (every, alike)):
        expected[:, 0] = case["mean"]
        if null_sample:
            expected[:, 1] = 0.0
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


def test_constant_samples_stay_within_the_limits(device):
    case = {**random_knots(2, samples=50), "lower": [-0.5, -0.1, 0.0], "upper": [0.2, 0.4, 0.3]}
    knots = perturb(**case, null_sample=True, constant=0.5, device=device)
    wanted = case["mean"][:, None] + case["sigma"][:, None] * case["z"][:, 3::2, :1]
    np.testing.assert_allclose(knots[:, 3::2], np.clip(wanted, case["lower"], case["upper"]), rtol=1e-5, atol=1e-5)


def test_null_sample_respects_limits_that_exclude_zero(device):
    ones = np.ones((1, 2, 1))
    knots = perturb(
        3.0 * ones, ones, np.eye(2), np.zeros((1, 2, 2, 1)), lower=[2.0], upper=[4.0], null_sample=True, device=device
    )
    np.testing.assert_array_equal(knots[0, :, :, 0], [[3.0, 3.0], [2.0, 2.0]])


def test_only_the_samples_asked_for_are_written(device):
    case = random_knots(5, samples=7)
    whole = perturb(**case, null_sample=True, device=device).reshape(14, 5, 3)
    part = perturb(**case, null_sample=True, first=4, device=device).reshape(14, 5, 3)
    assert not part[:4].any()
    np.testing.assert_array_equal(part[4:], whole[4:])


def test_a_single_sample_is_the_mean(device):
    mean = np.full((1, 2, 1), 0.25)
    z = np.ones((1, 1, 2, 1))
    knots = perturb(mean, mean, np.eye(2), z, lower=[-1.0], upper=[1.0], null_sample=True, device=device)
    np.testing.assert_array_equal(knots[0, 0], mean[0])


@given(seed=st.integers(0, 2**31 - 1), scale=st.floats(0.0, 1e4))
def test_no_knot_leaves_its_limits(seed, scale, device):
    rng = np.random.default_rng(seed)
    lower = rng.uniform(-2.0, 0.0, size=2).astype(np.float32)
    upper = (lower + rng.uniform(0.0, 3.0, size=2)).astype(np.float32)
    mean, sigma = scale * rng.normal(size=(1, 4, 2)), scale * rng.uniform(size=(1, 4, 2))
    z = rng.normal(size=(1, 8, 4, 2))
    knots = perturb(mean, sigma, np.eye(4), z, lower=lower, upper=upper, null_sample=False, device=device)
    assert np.all((knots >= lower) & (knots <= upper))


def test_shaped_noise_has_the_covariance_of_its_matrix(device):
    shaping = np.tril(np.random.default_rng(0).uniform(size=(4, 4)))
    shaping /= np.linalg.norm(shaping, axis=1, keepdims=True)
    z = np.random.default_rng(3).normal(size=(1, 8192, 4, 1))
    sigma = np.full((1, 4, 1), 2.0)
    free = {"lower": [-100.0], "upper": [100.0], "null_sample": False}
    knots = perturb(0.0 * sigma, sigma, shaping, z, **free, device=device)[0, 1:, :, 0]
    np.testing.assert_allclose(np.cov(knots.T), 4.0 * shaping @ shaping.T, atol=4.0 * 6.0 / np.sqrt(8192))
    np.testing.assert_allclose(knots.mean(axis=0), 0.0, atol=2.0 * 5.0 / np.sqrt(8192))


def test_white_noise_is_noise_shaped_by_the_identity(device):
    case = {**random_knots(2, samples=12), "shaping": None}
    white = perturb(**case, null_sample=True, constant=0.3, device=device)
    shaped = perturb(**{**case, "shaping": np.eye(5)}, null_sample=True, constant=0.3, device=device)
    np.testing.assert_array_equal(white, shaped)


@pytest.mark.parametrize("seed", range(3))
def test_a_full_covariance_correlates_the_controls_of_a_knot(seed, device):
    case, rng = random_knots(seed, samples=11), np.random.default_rng(seed)
    factor, schedule = np.tril(rng.normal(size=(2, 3, 3))), rng.uniform(0.1, 2.0, size=(2, 5))
    knots = perturb(**case, factor=factor, schedule=schedule, iteration=1, device=device)
    noise = np.einsum("euv,pq,esqv->espu", factor, case["shaping"], case["z"])
    expected = case["mean"][:, None] + schedule[1][:, None] * noise
    np.testing.assert_allclose(knots[:, 1:], expected[:, 1:], rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(knots[:, 0], case["mean"], rtol=1e-6)


def test_samples_of_a_full_covariance_have_it(device):
    rng = np.random.default_rng(0)
    factor = np.tril(rng.uniform(0.2, 1.0, size=(1, 3, 3)))
    z, zero = rng.normal(size=(1, 8192, 2, 3)), np.zeros((1, 2, 3))
    free = {"lower": [-100.0] * 3, "upper": [100.0] * 3}
    knots = perturb(zero, zero, None, z, factor=factor, **free, device=device)[0, 1:]
    for p in range(2):
        np.testing.assert_allclose(np.cov(knots[:, p].T), factor[0] @ factor[0].T, atol=4.0 * 6.0 / np.sqrt(8192))
    assert abs(np.corrcoef(knots[:, 0, 0], knots[:, 1, 0])[0, 1]) < 6.0 / np.sqrt(8192)


def test_fixed_rows_follow_the_mean_within_the_limits(device):
    case, rng = random_knots(1, samples=6), np.random.default_rng(1)
    case |= {"lower": np.full(3, -0.5), "upper": np.full(3, 0.5)}
    fixed = rng.normal(size=(3, 2, 5, 3))
    knots = perturb(**case, fixed=fixed, device=device)
    np.testing.assert_allclose(knots[:, 1:4], np.clip(fixed.swapaxes(0, 1), -0.5, 0.5), rtol=1e-6)
    np.testing.assert_array_equal(knots[:, 4:], perturb(**case, device=device)[:, 4:])


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("white", [False, True])
def test_threads_that_share_a_sample_change_no_bit(white, full, device):
    case = random_knots(2, samples=7)
    case["shaping"] = None if white else case["shaping"]
    factor = np.tril(np.random.default_rng(0).normal(size=(2, 3, 3))) if full else None
    alone, apart, uneven = (
        perturb(**case, factor=factor, constant=0.3, null_sample=True, lanes=lanes, device=device)
        for lanes in ((1, 1), (5, 15), (2, 4))
    )
    np.testing.assert_array_equal(alone, apart)
    np.testing.assert_array_equal(alone, uneven)
