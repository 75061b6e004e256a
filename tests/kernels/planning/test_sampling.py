# SPDX-License-Identifier: Apache-2.0
"""Standard normals from tables and counters, and knots that stay within their limits."""

import numpy as np
import pytest
import scipy.stats
import warp as wp
from hypothesis import given
from hypothesis import strategies as st

from warpmpc.kernels.planning.sampling import (
    advance_counter_kernel,
    age_plan_kernel,
    null_control_kernel,
    perturb_knots_kernel,
    random_normal_kernel,
    random_shift_kernel,
    start_plan_kernel,
    table_normal_kernel,
)


def table_normals(table: np.ndarray, shift: np.ndarray, *, knots: int, device: str) -> np.ndarray:
    """Run the kernel on a table [S, P·nu] and shifts [E, P·nu]; returns z [E, S, P, nu]."""
    z = wp.empty((len(shift), len(table), knots, table.shape[1] // knots), dtype=float, device=device)
    inputs = [wp.array(table, dtype=float, device=device), wp.array(shift, dtype=float, device=device)]
    dim = (z.shape[0] * z.shape[1], *z.shape[2:])
    wp.launch(table_normal_kernel, dim=dim, inputs=[*inputs, 0], outputs=[z], device=device)
    return z.numpy()


def random_normals(shape: tuple[int, ...], *, seed: int, count: int = 0, device: str) -> np.ndarray:
    """Pseudo-random z of this shape [E, S, P, nu] at this count of draws."""
    z = wp.empty(shape, dtype=float, device=device)
    counter = wp.full(shape[0], count, dtype=int, device=device)
    dim = (shape[0] * shape[1], *shape[2:])
    wp.launch(random_normal_kernel, dim=dim, inputs=[counter, seed, 0], outputs=[z], device=device)
    return z.numpy()


def random_shifts(shape: tuple[int, int], *, seed: int, count: int, device: str) -> np.ndarray:
    """Rotations of this shape [E, P·nu] at this count of draws."""
    shift = wp.empty(shape, dtype=float, device=device)
    counter = wp.full(shape[0], count, dtype=int, device=device)
    wp.launch(random_shift_kernel, dim=shape, inputs=[counter, seed], outputs=[shift], device=device)
    return shift.numpy()


def perturb(
    mean,
    sigma,
    shaping,
    z,
    *,
    lower,
    upper,
    null_sample: bool,
    null=None,
    schedule=None,
    iteration: int = 0,
    constant: float = 0.0,
    first: int = 0,
    device: str,
) -> np.ndarray:
    """Run the kernel on mean and σ [E, P, nu], B [P, P] and z [E, S, P, nu]; returns knots [E, S, P, nu]."""
    envs, samples, knots, nu = z.shape
    null = np.zeros((envs, nu)) if null is None else null
    schedule = np.ones((1, knots)) if schedule is None else schedule
    out = wp.zeros(z.shape, dtype=float, device=device)

    def on(a) -> wp.array:
        return wp.array(a, dtype=float, device=device)

    matrix = [on(np.zeros((1, 1)) if shaping is None else shaping), int(shaping is None)]
    inputs = [on(mean), on(sigma), on(schedule), iteration, *matrix, on(z), on(lower), on(upper), on(null)]
    inputs += [int(null_sample), constant, first]
    wp.launch(
        perturb_knots_kernel, dim=(envs * samples - first, knots, nu), inputs=inputs, outputs=[out], device=device
    )
    return out.numpy()


@pytest.mark.parametrize("seed", range(3))
def test_table_normals_match_the_inverse_distribution(seed, device):
    rng = np.random.default_rng(seed)
    table = rng.uniform(size=(33, 6)).astype(np.float32)
    shift = rng.uniform(size=(2, 6)).astype(np.float32)
    u = np.modf(table[None].astype(np.float64) + shift[:, None])[0]
    z = table_normals(table, shift, knots=3, device=device)
    # columns are knot by knot; the rotation itself is rounded to 6e-8, which the tails magnify
    np.testing.assert_allclose(z, scipy.stats.norm.ppf(u).reshape(2, 33, 3, 2), rtol=1e-5, atol=1e-4)


def test_table_normals_are_accurate_in_both_tails(device):
    u = np.array([1e-7, 1e-6, 1e-4, 0.02, 0.49, 0.5, 0.51, 0.98, 0.9999, 1.0 - 2.0**-20], dtype=np.float32)
    z = table_normals(u[:, None], np.zeros((1, 1)), knots=1, device=device)[0, :, 0, 0]
    np.testing.assert_allclose(z, scipy.stats.norm.ppf(u.astype(np.float64)), rtol=2e-5, atol=1e-6)


def test_table_normals_are_finite_at_the_ends_of_the_interval(device):
    table = np.array([[0.0], [1.0], [np.nextafter(np.float32(1.0), np.float32(0.0))], [1e-30]])
    z = table_normals(table, np.zeros((1, 1)), knots=1, device=device)
    assert np.all(np.isfinite(z))
    assert np.all(np.abs(z) > 5.0)


@pytest.mark.parametrize("seed", [0, 7, -1])
def test_random_normals_are_standard_and_uncorrelated(seed, device):
    z = random_normals((2, 4096, 3, 2), seed=seed, device=device).astype(np.float64)
    assert scipy.stats.kstest(z.ravel(), "norm").pvalue > 1e-3
    columns = z.transpose(1, 0, 2, 3).reshape(4096, -1)
    np.testing.assert_allclose(np.cov(columns.T), np.eye(12), atol=5.0 / np.sqrt(4096))
    along = np.corrcoef(z[:, :-1].ravel(), z[:, 1:].ravel())[0, 1]
    assert abs(along) < 5.0 / np.sqrt(z.size)


def test_random_normals_differ_between_all_indices_draws_and_seeds(device):
    draws = [random_normals((2, 64, 3, 2), seed=s, count=c, device=device) for s, c in [(0, 0), (0, 1), (1, 0), (1, 1)]]
    values = np.concatenate([d.ravel() for d in draws])
    assert len(np.unique(values)) > 0.999 * len(values)
    for i, a in enumerate(draws):
        for b in draws[i + 1 :]:
            assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 0.15


def test_random_normals_repeat_for_the_same_seed_and_count(device):
    a, b = (random_normals((1, 32, 4, 2), seed=5, count=3, device=device) for _ in range(2))
    np.testing.assert_array_equal(a, b)


def test_shifts_are_uniform_and_differ_between_environments_and_draws(device):
    first, second = (random_shifts((64, 32), seed=2, count=c, device=device) for c in (1, 2))
    for shift in (first, second):
        assert np.all((shift >= 0.0) & (shift < 1.0))
        assert scipy.stats.kstest(shift.ravel(), "uniform").pvalue > 1e-3
    assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.1
    assert abs(np.corrcoef(first[:-1].ravel(), first[1:].ravel())[0, 1]) < 0.1


def test_the_counter_of_an_observed_environment_advances_by_one(device):
    counter = wp.array([41, 7, 0], dtype=int, device=device)
    observed = wp.array([1, 0, 1], dtype=int, device=device)
    wp.launch(advance_counter_kernel, dim=3, inputs=[observed], outputs=[counter], device=device)
    assert counter.numpy().tolist() == [42, 7, 1]


@pytest.mark.parametrize("kernel", [random_normal_kernel, random_shift_kernel])
def test_every_environment_draws_by_its_own_counter(kernel, device):
    shape = (3, 8, 4, 2) if kernel is random_normal_kernel else (3, 64)

    def draw(counts: list[int]) -> np.ndarray:
        out = wp.empty(shape, dtype=float, device=device)
        counter = wp.array(counts, dtype=int, device=device)
        normals = kernel is random_normal_kernel
        dim, inputs = ((24, 4, 2), [counter, 5, 0]) if normals else (shape, [counter, 5])
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=[out], device=device)
        return out.numpy()

    together, apart = draw([2, 2, 2]), draw([2, 1, 2])
    np.testing.assert_array_equal(apart[[0, 2]], together[[0, 2]])
    assert abs(np.corrcoef(apart[1].ravel(), together[1].ravel())[0, 1]) < 0.5
    np.testing.assert_array_equal(apart[1], draw([1, 1, 1])[1])


def test_a_control_that_asks_for_nothing_holds_what_is_observed_or_rests(device):
    def on(values, dtype=float) -> wp.array:
        return wp.array(values, dtype=dtype, device=device)

    joint_q, held, rest = on([[0.3, 5.0, -0.2], [1.0, 2.0, 3.0]]), on([2, -1, 0, 1], int), on([9.0, 0.0, 9.0, 9.0])
    null = wp.zeros((2, 4), dtype=float, device=device)
    limits = [on([-1.0, -1.0, -1.0, 0.5]), on([1.0, 1.0, 1.0, 1.5])]
    wp.launch(null_control_kernel, dim=null.shape, inputs=[joint_q, held, rest, *limits], outputs=[null], device=device)
    np.testing.assert_allclose(null.numpy(), [[-0.2, 0.0, 0.3, 1.5], [1.0, 0.0, 1.0, 1.5]])


def test_a_first_plan_begins_at_rest_where_it_is_observed_and_a_later_one_goes_on(device):
    null = wp.array(np.arange(1.0, 7.0).reshape(3, 2), dtype=float, device=device)
    mean, last = wp.full((3, 4, 2), 9.0, dtype=float, device=device), wp.full((3, 2), 9.0, dtype=float, device=device)
    observed, fresh = (wp.array(a, dtype=int, device=device) for a in ([1, 0, 1], [1, 1, 0]))
    wp.launch(start_plan_kernel, dim=(3, 2), inputs=[observed, fresh, null], outputs=[mean, last], device=device)
    np.testing.assert_array_equal(mean.numpy()[0], np.tile([1.0, 2.0], (4, 1)))
    np.testing.assert_array_equal(last.numpy()[0], [1.0, 2.0])
    np.testing.assert_array_equal(mean.numpy()[1:], 9.0)
    np.testing.assert_array_equal(last.numpy()[1:], 9.0)
    wp.launch(age_plan_kernel, dim=3, inputs=[observed], outputs=[fresh], device=device)
    assert fresh.numpy().tolist() == [0, 1, 0]


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
    z = random_normals((1, 8192, 4, 1), seed=3, device=device)
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
