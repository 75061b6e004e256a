# SPDX-License-Identifier: Apache-2.0
"""Noise sources: how evenly they fill the space, and what a launch, a seed and an environment change."""

import numpy as np
import pytest
import scipy.stats
import warp as wp
from scipy.stats import qmc

from warpmpc.planner.noise import NoiseKind, NoiseSource, low_discrepancy_table

KINDS = pytest.mark.parametrize("source", list(NoiseKind))
TABLES = pytest.mark.parametrize("source", [NoiseKind.HALTON, NoiseKind.SOBOL])


def make(source: NoiseKind, device: str, **options) -> NoiseSource:
    """A source of E = 2, S = 128, P = 3, nu = 2 unless told otherwise."""
    return NoiseSource(**{"source": source, "envs": 2, "samples": 128, "knots": 3, "nu": 2, "device": device} | options)


def launch(noise: NoiseSource, observed=(1, 1)) -> None:
    """Draw anew for the environments that are observed."""
    noise.advance(wp.array(observed[: noise.z.shape[0]], dtype=int, device=noise.device))
    if noise.redraw:
        noise.draw(0, noise.z.shape[0] * noise.z.shape[1])


def values(noise: NoiseSource) -> np.ndarray:
    """A copy of the noise: on the CPU ``numpy()`` alone is a view that the next launch overwrites."""
    return noise.z.numpy().copy()


@KINDS
@pytest.mark.parametrize("redraw", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_noise_is_standard_normal(source, redraw, seed, device):
    noise = make(source, device, redraw=redraw, seed=seed, samples=1000)
    launch(noise)
    z = values(noise).astype(np.float64)
    assert z.shape == (2, 1000, 3, 2)
    assert np.all(np.isfinite(z))
    for row in z:
        columns = row.reshape(1000, 6)
        np.testing.assert_allclose(columns.mean(axis=0), 0.0, atol=5.0 / np.sqrt(1000))
        np.testing.assert_allclose(np.cov(columns.T), np.eye(6), atol=7.0 / np.sqrt(1000))


@TABLES
@pytest.mark.parametrize(("redraw", "starts"), [(False, False), (True, False), (True, True)])
def test_tables_fill_the_space_more_evenly_than_random_numbers(source, redraw, starts, device):
    def discrepancy(kind: NoiseKind, seed: int) -> float:
        noise = make(kind, device, seed=seed, redraw=redraw, starts=starts, envs=1, samples=256, knots=2)
        launch(noise)
        return qmc.discrepancy(scipy.stats.norm.cdf(values(noise).reshape(256, 4).astype(np.float64)))

    table = [discrepancy(source, seed) for seed in range(4)]
    random = [discrepancy(NoiseKind.RANDOM, seed) for seed in range(4)]
    assert max(table) < 0.6 * min(random)


@pytest.mark.parametrize(("samples", "columns"), [(1, 1), (64, 5), (300, 60)])
def test_halton_tables_are_scipys_to_the_last_bit(samples, columns):
    made = low_discrepancy_table(NoiseKind.HALTON, samples=samples, columns=columns, seed=samples)
    scipys = qmc.Halton(columns, scramble=True, rng=np.random.default_rng(samples)).random(samples)
    np.testing.assert_array_equal(made, scipys.astype(np.float32))


@KINDS
def test_noise_drawn_once_stays(source, device):
    noise = make(source, device, redraw=False)
    first = values(noise)
    assert np.any(first)
    launch(noise)
    np.testing.assert_array_equal(values(noise), first)


@KINDS
def test_redrawn_noise_changes_at_every_launch_and_environment_in_the_same_array(source, device):
    noise = make(source, device, redraw=True)
    array, draws = noise.z, []
    for _ in range(3):
        launch(noise)
        draws += list(values(noise).reshape(2, -1))
    assert noise.z is array
    correlation = np.corrcoef(draws)
    np.testing.assert_allclose(correlation, np.eye(6), atol=0.3)
    assert len(np.unique(np.asarray(draws)[:, 0])) == 6


@TABLES
def test_a_table_drawn_once_is_shared_by_all_environments(source, device):
    z = values(make(source, device))
    np.testing.assert_array_equal(z[0], z[1])


@KINDS
@pytest.mark.parametrize("redraw", [False, True])
def test_a_seed_repeats_its_noise_and_another_does_not(source, redraw, device):
    def draw(seed: int) -> np.ndarray:
        noise = make(source, device, redraw=redraw, seed=seed)
        launch(noise)
        launch(noise)
        return values(noise)

    np.testing.assert_array_equal(draw(3), draw(3))
    assert abs(np.corrcoef(draw(3)[0].ravel(), draw(4)[0].ravel())[0, 1]) < 0.3


@KINDS
def test_reset_starts_over(source, device):
    noise = make(source, device, redraw=True)
    fresh = values(noise)
    launch(noise)
    first = values(noise)
    launch(noise)
    noise.reset()
    np.testing.assert_array_equal(values(noise), fresh)
    launch(noise)
    np.testing.assert_array_equal(values(noise), first)


@KINDS
def test_an_environment_that_waits_goes_on_later_as_if_it_had_not(source, device):
    noise, other = (make(source, device, redraw=True, seed=2) for _ in range(2))
    launch(noise)
    launch(other)
    launch(noise, (1, 0))
    np.testing.assert_array_equal(values(noise)[1], values(other)[1])
    launch(noise)
    launch(other)
    np.testing.assert_array_equal(values(noise)[1], values(other)[1])
    assert not np.array_equal(values(noise)[0], values(other)[0])


@TABLES
@pytest.mark.parametrize("samples", [1, 2, 100, 129])
def test_any_number_of_samples_is_served_without_a_warning(source, samples, device, recwarn):
    z = values(make(source, device, samples=samples))
    assert z.shape[1] == samples
    assert len(np.unique(z[0, :, 0, 0])) == samples
    assert not [w for w in recwarn if issubclass(w.category, UserWarning)]


def test_a_source_may_be_named_by_its_word(device):
    assert make("sobol", device).source is NoiseKind.SOBOL
    with pytest.raises(ValueError, match="pink"):
        make("pink", device)


def test_spread_scales_samples_geometrically(device):
    shape = {"samples": 65, "knots": 3, "nu": 2}
    plain = NoiseSource(source="halton", seed=1, device=device, **shape).z.numpy().copy()
    spread = NoiseSource(source="halton", seed=1, spread=(0.25, 4.0), device=device, **shape).z.numpy()
    ratio = (spread / plain)[0]
    np.testing.assert_allclose(ratio[0], 0.25, rtol=1e-5)
    np.testing.assert_allclose(ratio[32], 1.0, rtol=1e-5)
    np.testing.assert_allclose(ratio[64], 4.0, rtol=1e-5)
    assert np.all(np.diff(ratio[:, 0, 0]) > 0.0)


@TABLES
def test_columns_read_from_other_starts_keep_their_values(source, device):
    """As many samples of every range as before, in their own order by column, draw and environment."""
    noise = make(source, device, redraw=True, starts=True)
    table = values(noise)
    draws = []
    for _ in range(3):
        launch(noise)
        draws.append(values(noise))
        np.testing.assert_array_equal(np.sort(draws[-1], axis=1), np.sort(table, axis=1))
    assert not np.array_equal(draws[0], draws[1])
    assert not np.array_equal(draws[0][0], draws[0][1])
    first = np.argmax(draws[0][0].reshape(128, 6), axis=0)
    assert len(set((first - np.argmax(table[0].reshape(128, 6), axis=0)) % 128)) > 1
    noise.reset()
    launch(noise)
    np.testing.assert_array_equal(values(noise), draws[0])
