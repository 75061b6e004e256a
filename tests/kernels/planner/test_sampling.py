# SPDX-License-Identifier: Apache-2.0
"""Standard normals from tables and counters, and where plans start."""

import numpy as np
import pytest
import scipy.stats
import warp as wp

from warpmpc.kernels.planner.sampling import (
    advance_counter_kernel,
    age_plan_kernel,
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


def started(joint_q, held, rest, limits, observed, fresh, *, knots: int, device: str) -> list[np.ndarray]:
    """Controls that ask for nothing ``[E, nu]``, plans ``[E, P, nu]`` and last controls that were all 9 before."""

    def on(values, dtype=float) -> wp.array:
        return wp.array(values, dtype=dtype, device=device)

    envs, nu = len(joint_q), len(held)
    inputs = [on(observed, int), on(fresh, int), on(joint_q), on(held, int), on(rest), *(on(limit) for limit in limits)]
    shapes = ((envs, nu), (envs, knots, nu), (envs, nu))
    outputs = [wp.full(shape, 9.0, dtype=float, device=device) for shape in shapes]
    wp.launch(start_plan_kernel, dim=(envs, nu), inputs=inputs, outputs=outputs, device=device)
    return [array.numpy() for array in outputs]


def test_a_control_that_asks_for_nothing_holds_what_is_observed_or_rests(device):
    joint_q, held, rest = [[0.3, 5.0, -0.2], [1.0, 2.0, 3.0]], [2, -1, 0, 1], [9.0, 0.0, 9.0, 9.0]
    limits = [-1.0, -1.0, -1.0, 0.5], [1.0, 1.0, 1.0, 1.5]
    null, *_ = started(joint_q, held, rest, limits, [1, 1], [0, 0], knots=2, device=device)
    np.testing.assert_allclose(null, [[-0.2, 0.0, 0.3, 1.5], [1.0, 0.0, 1.0, 1.5]])


def test_a_first_plan_begins_at_rest_where_it_is_observed_and_a_later_one_goes_on(device):
    joint_q = np.arange(1.0, 7.0).reshape(3, 2)
    limits = [-10.0, -10.0], [10.0, 10.0]
    flags = [1, 0, 1], [1, 1, 0]
    null, mean, last = started(joint_q, [0, 1], [0.0, 0.0], limits, *flags, knots=4, device=device)
    np.testing.assert_array_equal(null, joint_q)
    np.testing.assert_array_equal(mean[0], np.tile([1.0, 2.0], (4, 1)))
    np.testing.assert_array_equal(last[0], [1.0, 2.0])
    np.testing.assert_array_equal(mean[1:], 9.0)
    np.testing.assert_array_equal(last[1:], 9.0)
    observed, fresh = (wp.array(a, dtype=int, device=device) for a in flags)
    wp.launch(age_plan_kernel, dim=3, inputs=[observed], outputs=[fresh], device=device)
    assert fresh.numpy().tolist() == [0, 1, 0]
