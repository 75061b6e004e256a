# SPDX-License-Identifier: Apache-2.0
"""Stage costs to the cost of a sample against float64 references, and what a diverged world may not do."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st

from warpmpc.kernels.planner.costs import (
    BEST,
    CVAR,
    EXPONENTIAL,
    MEAN,
    VAR,
    WORST,
    CostWeights,
    explain_kernel,
    finish_kernel,
)

INF = np.inf


def on(device: str, array, dtype=float) -> wp.array:
    """Copy of an array-like on the device."""
    return wp.array(np.asarray(array), dtype=dtype, device=device)


class Finished:
    """Rollout costs [W], sample costs [E, S] and totals [term, W] of stage costs [term, T, W] on the record."""

    def __init__(
        self,
        stage_cost,
        weight,
        *,
        envs=1,
        domains=1,
        mode=MEAN,
        alpha=1.0,
        stage_risk=0.0,
        failed=None,
        observed=None,
        first=0,
        before=0.0,
        device,
    ):
        self.device, terms, worlds = device, stage_cost.shape[0], stage_cost.shape[2]
        samples = worlds // domains // envs
        shapes = (terms, worlds), worlds, (envs, samples)
        self.total, self.rollout, self.sample = (wp.full(x, before, dtype=float, device=device) for x in shapes)
        failed = np.zeros(worlds) if failed is None else failed
        observed = np.ones(envs) if observed is None else observed
        self.over = [domains, mode, alpha]
        inputs = [on(device, stage_cost), on(device, range(terms), int), wp.zeros(0, dtype=int, device=device)]
        weights = CostWeights()
        weights.discount = on(device, weight)
        inputs += [weights, stage_risk, on(device, failed, int), on(device, observed, int), *self.over]
        outputs = [self.total, self.rollout, wp.zeros(worlds, dtype=int, device=device), self.sample]
        dim = envs * samples - first
        wp.launch(finish_kernel, dim=dim, inputs=[*inputs, first], outputs=outputs, device=device)

    def explain(self, best) -> np.ndarray:
        """Parts of the terms [E, term] in the costs of samples [E]."""
        found = wp.zeros((len(best), self.total.shape[0]), dtype=float, device=self.device)
        inputs = [self.total, self.rollout, on(self.device, best, int), self.sample.shape[1], *self.over]
        wp.launch(explain_kernel, dim=found.shape, inputs=inputs, outputs=[found], device=self.device)
        return found.numpy()


def discounted(
    stage_cost: np.ndarray, diverged: np.ndarray, *, discount: float, stage_risk: float = 0.0, device: str
) -> np.ndarray:
    """Rollout costs [W] of stage costs [term, T, W]."""
    weight = float(discount) ** np.arange(stage_cost.shape[1])
    return Finished(stage_cost, weight, failed=diverged, stage_risk=stage_risk, device=device).rollout.numpy()


def risk(cost: np.ndarray, *, mode: int, alpha: float = 1.0, device: str) -> np.ndarray:
    """Sample costs [E, S] of rollout costs [E, S, D]."""
    envs, _, domains = cost.shape
    over = {"envs": envs, "domains": domains, "mode": mode, "alpha": alpha}
    return Finished(cost.reshape(1, 1, -1), [1.0], **over, device=device).sample.numpy()


# discounted sums


@pytest.mark.parametrize("discount", [1.0, 0.95, 0.0])
def test_discounted_sum_matches_the_reference(discount, device):
    stage = np.random.default_rng(0).uniform(size=(3, 12, 17))
    total = np.einsum("itw,t->w", stage, discount ** np.arange(12))
    np.testing.assert_allclose(discounted(stage, np.zeros(17), discount=discount, device=device), total, rtol=1e-5)


@pytest.mark.parametrize("bad", [np.nan, INF, -INF])
def test_a_non_finite_stage_cost_makes_its_world_infinite_and_no_other(bad, device):
    stage = np.ones((2, 4, 3))
    stage[1, 2, 1] = bad
    np.testing.assert_array_equal(discounted(stage, np.zeros(3), discount=1.0, device=device), [8.0, INF, 8.0])


def test_a_world_flagged_as_diverged_is_infinite_though_it_looks_cheap(device):
    cost = discounted(np.zeros((1, 4, 3)), np.array([0, 1, 0]), discount=1.0, device=device)
    np.testing.assert_array_equal(cost, [0.0, INF, 0.0])


def test_steps_count_by_their_weights_and_only_the_worlds_asked_for_are_summed(device):
    rng = np.random.default_rng(1)
    stage, weight = rng.normal(size=(2, 5, 7)), rng.uniform(size=5)
    out = Finished(stage, weight, first=3, before=-1.0, device=device).rollout.numpy()
    np.testing.assert_array_equal(out[:3], -1.0)
    np.testing.assert_allclose(out[3:], np.einsum("itw,t->w", stage, weight)[3:], atol=1e-5)


ADDING_UP = [(MEAN, 1.0), (WORST, 1.0), (CVAR, 0.3), (CVAR, 0.5), (CVAR, 0.01), (BEST, 1.0), (VAR, 0.3), (VAR, 0.5)]


@pytest.mark.parametrize("stage_risk", [-2.0, -1e-3, 1e-3, 0.05, 1.5])
def test_a_step_costs_what_its_stage_risk_makes_of_all_terms(stage_risk, device):
    stage = np.random.default_rng(2).uniform(-0.2, 1.0, size=(3, 5, 7)).astype(np.float32)
    cost = discounted(stage, np.zeros(7), discount=0.9, stage_risk=stage_risk, device=device)
    summed = stage.astype(np.float64).sum(axis=0)
    expected = np.einsum("tw,t->w", np.expm1(stage_risk * summed) / stage_risk, 0.9 ** np.arange(5))
    np.testing.assert_allclose(cost, expected, rtol=3e-6)


@pytest.mark.parametrize("stage_risk", [-1.0, 2.0])
def test_terms_add_up_to_the_cost_under_a_stage_risk(stage_risk, device):
    stage = np.random.default_rng(3).uniform(size=(3, 5, 4)).astype(np.float32)
    finished = Finished(stage, np.ones(5), stage_risk=stage_risk, device=device)
    assert finished.explain([2]).sum() == pytest.approx(finished.rollout.numpy()[2], rel=1e-5)


@pytest.mark.parametrize(("mode", "alpha"), ADDING_UP)
@pytest.mark.parametrize("domains", [1, 4, 5])
@pytest.mark.parametrize("seed", range(2))
def test_the_terms_of_a_sample_add_up_to_its_cost_over_the_domains(seed, domains, mode, alpha, device):
    rng = np.random.default_rng(seed)
    envs, samples, terms, steps = 2, 3, 4, 6
    stage = rng.normal(size=(terms, steps, envs * samples * domains)).astype(np.float32)
    weight = rng.uniform(size=steps)
    rollout = np.einsum("itw,t->w", stage.astype(np.float64), weight)
    cost = risk(rollout.reshape(envs, samples, domains), mode=mode, alpha=alpha, device=device)
    best = [2, 1]
    finished = Finished(stage, weight, envs=envs, domains=domains, mode=mode, alpha=alpha, device=device)
    found = finished.explain(best)
    np.testing.assert_allclose(found.sum(axis=1), [cost[e, s] for e, s in enumerate(best)], atol=2e-5)
    if mode == MEAN:
        parts = np.einsum("itw,t->iw", stage.astype(np.float64), weight).reshape(terms, envs, samples, domains)
        expected = np.stack([parts[:, e, s].mean(axis=1) for e, s in enumerate(best)])
        np.testing.assert_allclose(found, expected, atol=1e-5)


# risk over domains


def test_samples_of_an_environment_without_an_observation_are_infinite(device):
    finished = Finished(np.ones((1, 1, 12)), [1.0], envs=3, observed=[1, 0, 1], first=1, device=device)
    out = finished.sample.numpy()
    np.testing.assert_array_equal(out, [[0.0, 1.0, 1.0, 1.0], [INF] * 4, [1.0] * 4])  # row 0 is another part


def reference_cvar(cost: np.ndarray, alpha: float) -> float:
    """CVaR of costs [D] as the minimum of Rockafellar and Uryasev, reached at one of the costs."""
    return min(v + np.maximum(cost - v, 0.0).mean() / alpha for v in cost)


@pytest.mark.parametrize("domains", [1, 2, 5, 8])
@pytest.mark.parametrize("alpha", [0.01, 0.2, 0.3, 0.5, 1.0])
def test_risk_matches_the_reference(domains, alpha, device):
    cost = np.random.default_rng(domains).normal(size=(2, 7, domains)).astype(np.float32)
    wide = cost.astype(np.float64)
    np.testing.assert_allclose(risk(cost, mode=MEAN, device=device), wide.mean(axis=2), rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(risk(cost, mode=WORST, device=device), cost.max(axis=2))
    expected = np.apply_along_axis(reference_cvar, 2, wide, alpha)
    np.testing.assert_allclose(risk(cost, mode=CVAR, alpha=alpha, device=device), expected, rtol=1e-5, atol=1e-5)


@given(seed=st.integers(0, 2**31 - 1), alpha=st.floats(0.01, 1.0), domains=st.integers(1, 6), ties=st.booleans())
def test_cvar_lies_between_mean_and_worst_whatever_the_order_of_domains(seed, alpha, domains, ties, device):
    rng = np.random.default_rng(seed)
    cost = rng.normal(size=(1, 3, domains)).astype(np.float32)
    cost = np.round(cost) if ties else cost
    cvar = risk(cost, mode=CVAR, alpha=alpha, device=device)
    assert np.all(cvar >= risk(cost, mode=MEAN, device=device) - 1e-5)
    assert np.all(cvar <= risk(cost, mode=WORST, device=device) + 1e-5)
    mixed = rng.permuted(cost, axis=2)
    np.testing.assert_allclose(risk(mixed, mode=CVAR, alpha=alpha, device=device), cvar, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("mode", [MEAN, WORST, CVAR])
def test_one_domain_is_a_plain_copy(mode, device):
    cost = np.random.default_rng(1).normal(size=(2, 50, 1)).astype(np.float32)
    cost[0, 3] = INF
    np.testing.assert_array_equal(risk(cost, mode=mode, alpha=0.37, device=device), cost[:, :, 0])


@pytest.mark.parametrize("mode", [MEAN, WORST, CVAR])
def test_any_diverged_domain_condemns_its_sample_only(mode, device):
    cost = np.ones((2, 3, 4))
    cost[1, 0, 2] = INF
    cost[0, 2, :3] = INF
    expected = np.ones((2, 3))
    expected[[1, 0], [0, 2]] = INF
    np.testing.assert_array_equal(risk(cost, mode=mode, alpha=0.5, device=device), expected)


@pytest.mark.parametrize("domains", [1, 2, 5, 10])
@pytest.mark.parametrize("alpha", [0.01, 0.1, 0.3, 0.5, 1.0])
@pytest.mark.parametrize("ties", [False, True])
def test_best_and_var_are_order_statistics(domains, alpha, ties, device):
    cost = np.random.default_rng(domains).normal(size=(2, 7, domains)).astype(np.float32)
    cost = np.round(cost) if ties else cost
    np.testing.assert_array_equal(risk(cost, mode=BEST, device=device), cost.min(axis=2))
    worst_first = -np.sort(-cost, axis=2)
    mildest = max(int(np.ceil(round(alpha * domains, 6))) - 1, 0)
    np.testing.assert_array_equal(risk(cost, mode=VAR, alpha=alpha, device=device), worst_first[..., mildest])


@pytest.mark.parametrize("aversion", [-3.0, 0.0, 0.5, 40.0])
@pytest.mark.parametrize("scale", [1.0, 1000.0])
def test_the_exponential_risk_matches_the_reference_and_does_not_overflow(aversion, scale, device):
    cost = scale * np.random.default_rng(7).normal(size=(2, 7, 5)).astype(np.float32)
    wide = cost.astype(np.float64)
    expected = wide.mean(axis=2)
    if aversion:
        expected = (np.logaddexp.reduce(aversion * wide, axis=2) - np.log(5)) / aversion
    found = risk(cost, mode=EXPONENTIAL, alpha=aversion, device=device)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5 * scale)


@pytest.mark.parametrize("mode", [MEAN, WORST, BEST, CVAR, VAR, EXPONENTIAL])
def test_one_diverged_domain_makes_the_sample_infinite_whatever_the_risk(mode, device):
    cost = np.array([[[1.0, INF, 2.0], [1.0, 3.0, 2.0]]], dtype=np.float32)
    found = risk(cost, mode=mode, alpha=0.5, device=device)
    assert np.isinf(found[0, 0])
    assert np.isfinite(found[0, 1])
