# SPDX-License-Identifier: Apache-2.0
"""The covariance that follows weighted samples, in every form, against a float64 reference and at its limits."""

import numpy as np
import pytest
import warp as wp

from warpmpc.planner.covariance import Covariance, SampleMoments
from warpmpc.scene.schema import CovarianceForm

ADAPTED = pytest.mark.parametrize("form", [form for form in CovarianceForm if form is not CovarianceForm.FIXED])
FULL = (CovarianceForm.FULL, CovarianceForm.FULL_KNOTS)
ENVS, KNOTS, NU = 2, 5, 3
SIGMA = np.array([0.5, 1.0, 2.0])


def make(form: CovarianceForm, device: str, **options) -> Covariance:
    """A covariance of E = 2, P = 5 and three controls that starts at SIGMA."""
    defaults = {"sigma_min": np.zeros(NU), "kappa": np.zeros(NU), "step_size": 1.0, "schedule": np.ones((1, KNOTS))}
    return Covariance(form, **{"sigma": SIGMA, **defaults, **options}, envs=ENVS, device=device)


def on(array, device: str, dtype=float) -> wp.array:
    """Copy of an array-like on the device."""
    return wp.array(np.asarray(array), dtype=dtype, device=device)


def follow(covariance: Covariance, knots, weight, mean, *, iteration: int = 0) -> np.ndarray:
    """The covariance [E, P, nu, nu] after one update from knots [E, S, P, nu]."""
    arrays = (on(a, covariance.device) for a in (knots, weight))
    moments = SampleMoments(*arrays, full=covariance.full)
    covariance.follow(moments, on(mean, covariance.device), iteration)
    return dense(covariance)


def dense(covariance: Covariance) -> np.ndarray:
    """Covariance that samples are drawn with ``[E, P, nu, nu]``, in float64."""
    if covariance.full:
        factor = covariance.factor.numpy().astype(np.float64).reshape(ENVS, -1, NU, NU)
        return np.broadcast_to(factor @ factor.swapaxes(2, 3), (ENVS, KNOTS, NU, NU))
    variance = covariance.sigma.numpy().astype(np.float64) ** 2
    return variance[..., None] * np.eye(NU)


def reference(form, before, knots, weight, mean, *, alpha, floor, schedule) -> np.ndarray:
    """Bhardwaj et al. 2021, Eq. 5, in float64: covariance [E, P, nu, nu] of all knots."""
    deviation = (knots - mean[:, None]) / schedule[:, None]
    target = np.einsum("es,espu,espv->epuv", weight / weight.sum(axis=1, keepdims=True), deviation, deviation)
    if form in FULL:
        target = target.mean(axis=1, keepdims=True) if form is CovarianceForm.FULL else target
        return (1.0 - alpha) * before + alpha * target
    variance = np.einsum("epuu->epu", target)
    if form is CovarianceForm.DIAGONAL:
        variance = np.broadcast_to(variance.mean(axis=1, keepdims=True), variance.shape)
    variance = (1.0 - alpha) * np.einsum("epuu->epu", before) + alpha * variance
    return np.maximum(variance, floor**2)[..., None] * np.eye(NU)


def some_samples(seed: int, samples: int = 40):
    """Knots [2, S, 5, 3] with correlated controls, weights [2, S], and a mean [2, 5, 3]."""
    rng = np.random.default_rng(seed)
    knots = rng.normal(size=(ENVS, samples, KNOTS, NU)) @ rng.normal(size=(NU, NU))
    weight = np.exp(-rng.gamma(2.0, 1.0, size=(ENVS, samples)))
    return knots, weight, rng.normal(size=(ENVS, KNOTS, NU))


@ADAPTED
@pytest.mark.parametrize("alpha", [0.3, 1.0])
@pytest.mark.parametrize("seed", range(3))
def test_every_form_matches_the_reference_update_by_update(form, alpha, seed, device):
    schedule = np.random.default_rng(seed).uniform(0.3, 2.0, size=(3, KNOTS))
    covariance = make(form, device, step_size=alpha, schedule=schedule)
    expected = dense(covariance)
    for i in range(3):
        knots, weight, mean = some_samples(10 * seed + i)
        found = follow(covariance, knots, weight, mean, iteration=i)
        known = {"alpha": alpha, "floor": np.zeros(NU), "schedule": schedule[i][None, :, None]}
        expected = reference(form, expected, knots, weight, mean, **known)
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)


@ADAPTED
def test_the_floor_holds_where_the_samples_agree(form, device):
    floor = np.array([0.1, 0.2, 0.3])
    covariance = make(form, device, sigma_min=floor)
    knots = np.ones((ENVS, 8, KNOTS, NU))
    found = follow(covariance, knots, np.ones((ENVS, 8)), knots[:, 0])
    np.testing.assert_allclose(found, np.broadcast_to(np.diag(floor**2), found.shape), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("form", FULL)
@pytest.mark.parametrize("floor", [0.0, 0.01])
def test_a_full_covariance_of_too_few_samples_has_a_factor(form, floor, device):
    """One direction for three controls: the pivots of the others are lifted to the floor, the direction stays."""
    direction = np.array([1.0, -2.0, 0.5])
    covariance = make(form, device, sigma_min=np.full(NU, floor))
    knots = np.tile(direction, (ENVS, 2, KNOTS, 1)) * np.array([1.0, -1.0])[None, :, None, None]
    found = follow(covariance, knots, np.ones((ENVS, 2)), np.zeros((ENVS, KNOTS, NU)))[0, 0]
    np.testing.assert_allclose(found, np.outer(direction, direction) + np.diag([0.0, floor**2, floor**2]), atol=1e-5)
    factor = covariance.factor.numpy()
    assert np.all(np.isfinite(factor))
    assert np.all(np.einsum("euu->eu", factor) >= floor - 1e-7)
    np.testing.assert_allclose(covariance.covariance.numpy()[0], found, atol=1e-5)


@ADAPTED
def test_an_environment_without_weights_keeps_its_covariance_bit_by_bit(form, device):
    knots, weight, mean = some_samples(3)
    alone, other = make(form, device, step_size=0.4), make(form, device, step_size=0.4)
    follow(alone, knots, weight, mean)
    follow(other, knots, weight, mean)
    kept = dense(alone)
    weight[1] = 0.0
    found = follow(alone, 2.0 * knots, weight, mean)
    np.testing.assert_array_equal(found[1], kept[1])
    assert not np.allclose(found[0], kept[0])
    weight[1] = 1.0
    np.testing.assert_array_equal(follow(other, 2.0 * knots, weight, mean)[0], found[0])


@ADAPTED
def test_kappa_is_added_where_a_plan_moves_on(form, device):
    kappa = np.array([0.05, 0.1, 0.2])
    covariance = make(form, device, kappa=kappa)
    before = dense(covariance)
    for observed, fresh, grown in (([1, 1], [1, 0], [0, 1]), ([1, 0], [0, 0], [1, 1]), ([1, 1], [0, 0], [2, 2])):
        covariance.grow(on(observed, device, int), on(fresh, device, int))
        expected = before + np.array(grown)[:, None, None, None] * np.diag(kappa)
        np.testing.assert_allclose(dense(covariance), expected, rtol=1e-5, atol=1e-6)
    knots, weight, mean = some_samples(1)
    follow(covariance, knots, weight, mean)
    covariance.grow(on([1, 1], device, int), on([0, 0], device, int))
    covariance.reset()
    np.testing.assert_allclose(dense(covariance), before, rtol=1e-6)
    if form in FULL:  # what samples are drawn by
        bands = covariance.bands.numpy().reshape(ENVS, NU, KNOTS, NU)
        np.testing.assert_array_equal(bands[:, 0], np.broadcast_to(SIGMA.astype(np.float32), (ENVS, KNOTS, NU)))
        assert not bands[:, 1:].any()


@pytest.mark.parametrize("form", FULL)
def test_the_bands_are_those_of_the_factor(form, device):
    covariance = make(form, device)
    follow(covariance, *some_samples(2))
    factor, bands = covariance.factor.numpy(), covariance.bands.numpy().reshape(ENVS, NU, KNOTS, NU)
    factor = np.broadcast_to(factor.reshape(ENVS, -1, NU, NU), (ENVS, KNOTS, NU, NU))
    for u in range(NU):
        for v in range(NU):
            if v <= u:
                np.testing.assert_array_equal(bands[:, u - v, :, u], factor[:, :, u, v])
            else:
                assert not factor[:, :, u, v].any()


@pytest.mark.parametrize("seed", range(3))
def test_a_full_covariance_finds_the_valley_that_a_diagonal_one_does_not(seed, device):
    """Cross entropy on ½ xᵀ A x, whose valley of condition 400 runs along no axis; 30 rounds of 100 samples."""

    def distance(form: CovarianceForm) -> float:
        rng = np.random.default_rng(seed)
        turn = np.linalg.qr(np.ones((NU, NU)) + np.diag([1.0, 2.0, 3.0]))[0]
        hessian = turn @ np.diag([1.0, 20.0, 400.0]) @ turn.T
        options = {"sigma": np.full(NU, 1.0), "schedule": np.ones((1, 1)), "sigma_min": np.full(NU, 1e-4)}
        covariance = make(form, device, step_size=0.5, **options)
        start = 3.0 * turn[:, 0]  # far along the valley
        mean = on(np.broadcast_to(start, (ENVS, 1, NU)).copy(), device)
        for _ in range(30):
            if covariance.full:
                factor = covariance.factor.numpy().astype(np.float64)
            else:
                factor = covariance.sigma.numpy()[:, 0, :, None] * np.eye(NU)
            x = mean.numpy() + np.einsum("euv,esv->esu", factor, rng.normal(size=(ENVS, 100, NU)))
            cost = 0.5 * np.einsum("esu,uv,esv->es", x, hessian, x)
            weight = np.argsort(np.argsort(cost, axis=1), axis=1) < 25
            moments = SampleMoments(on(x[:, :, None], device), on(weight, device), full=covariance.full)
            moments.move_mean(mean, 1.0)
            covariance.follow(moments, mean, 0)
        return float(np.linalg.norm(mean.numpy(), axis=-1).mean())

    full, diagonal = distance(CovarianceForm.FULL), distance(CovarianceForm.DIAGONAL)
    assert full < 0.05
    assert diagonal > 1.0
