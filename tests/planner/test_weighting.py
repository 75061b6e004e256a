# SPDX-License-Identifier: Apache-2.0
"""Weightings on their state: what each writes, adapts and refuses."""

import numpy as np
import pytest
import warp as wp
from needs import CUDA, need

from warpmpc.planner.weighting import Adaptation, CrossEntropy, Mppi, PredictiveSampling, Tsallis, WeightingState

WEIGHTINGS = [
    Mppi(),
    Mppi(adapt=Adaptation.ESS, target_ess=4.0),
    Mppi(adapt=Adaptation.FIXED),
    PredictiveSampling(),
    CrossEntropy(elites=4),
    Tsallis(elites=4),
]
ALL = pytest.mark.parametrize("weighting", WEIGHTINGS, ids=["eta", "ess", "fixed", "predictive", "cem", "tsallis"])


def make_state(cost, *, temperature: float = 1.0, device: str) -> WeightingState:
    """A state that holds these costs [E, S]."""
    cost = np.asarray(cost, dtype=np.float32)
    return WeightingState(wp.array(cost, dtype=float, device=device), temperature=temperature)


def effective_samples(weight: np.ndarray) -> np.ndarray:
    """Effective sample size of every row of weights."""
    return weight.sum(axis=-1) ** 2 / (weight**2).sum(axis=-1)


@ALL
def test_cheaper_samples_carry_more_weight(weighting, device):
    cost = np.random.default_rng(0).uniform(0.0, 20.0, size=(3, 64))
    state = make_state(cost, device=device)
    weighting.launch(state)
    weight = state.weight.numpy()
    np.testing.assert_allclose(weight.sum(axis=1), 1.0, rtol=1e-5)
    for e in range(3):
        assert np.all(np.diff(weight[e][np.argsort(cost[e])]) <= 0.0)
        assert weight[e, cost[e].argmin()] > 0.0
    assert np.all(state.eta.numpy() >= 1.0)


@ALL
def test_an_environment_that_diverged_has_neither_weights_nor_effective_samples(weighting, device):
    state = make_state([[1.0] * 8, [np.inf] * 8], temperature=2.0, device=device)
    weighting.launch(state)
    assert state.weight.numpy().sum(axis=1).tolist() == [1.0, 0.0]
    assert state.eta.numpy()[1] == 0.0
    assert state.beta.numpy()[1] == 2.0


def test_eta_adaptation_ends_within_its_bounds(device):
    cost = np.random.default_rng(1).gamma(2.0, 50.0, size=(2, 300))
    state = make_state(cost, temperature=1e-2, device=device)
    weighting = Mppi(eta=(5.0, 10.0))
    for _ in range(100):
        weighting.launch(state)
    assert np.all((state.eta.numpy() >= 5.0) & (state.eta.numpy() <= 10.0))


@pytest.mark.parametrize("target", [3.0, 20.0])
def test_ess_adaptation_is_met_in_one_launch_in_every_environment(target, device):
    cost = np.random.default_rng(2).gamma(2.0, 1.0, size=(3, 200)) * np.array([[0.01], [1.0], [500.0]])
    state = make_state(cost, device=device)
    Mppi(adapt=Adaptation.ESS, target_ess=target).launch(state)
    np.testing.assert_allclose(effective_samples(state.weight.numpy().astype(np.float64)), target, rtol=1e-3)


@pytest.mark.parametrize("index", [1.5, 2.0, 5.0])
def test_tsallis_weights_match_the_reference(index, device):
    cost = np.random.default_rng(4).gamma(2.0, 3.0, size=(2, 65)).astype(np.float32)
    cost[1, 3] = np.inf
    state = make_state(cost, device=device)
    Tsallis(elites=6, entropic_index=index).launch(state)
    wide = cost.astype(np.float64)
    excess = wide - wide.min(axis=1, keepdims=True)
    gamma = np.sort(excess, axis=1)[:, 6:7]
    expected = np.maximum(1.0 - excess / gamma, 0.0) ** (1.0 / (index - 1.0))
    expected /= expected.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(state.weight.numpy(), expected, rtol=1e-4, atol=1e-6)
    assert np.count_nonzero(state.weight.numpy(), axis=1).tolist() == [6, 6]


def test_tsallis_elites_that_tie_or_are_all_there_weigh_the_same(device):
    state = make_state([[2.0, 2.0, 2.0, 2.0, 5.0], [1.0, np.inf, 3.0, np.inf, np.inf]], device=device)
    Tsallis(elites=3).launch(state)
    expected = [[0.25, 0.25, 0.25, 0.25, 0.0], [0.5, 0.0, 0.5, 0.0, 0.0]]
    np.testing.assert_allclose(state.weight.numpy(), expected)


def test_a_fixed_temperature_stays(device):
    state = make_state([np.arange(50.0)], temperature=0.1, device=device)
    Mppi(adapt=Adaptation.FIXED).launch(state)
    assert state.beta.numpy()[0] == np.float32(0.1)


def test_reset_returns_to_the_initial_temperature(device):
    state = make_state([np.arange(50.0)], temperature=0.1, device=device)
    Mppi().launch(state)
    assert state.beta.numpy()[0] != np.float32(0.1)
    state.reset()
    assert state.beta.numpy()[0] == np.float32(0.1)
    assert not state.weight.numpy().any()


def test_only_cross_entropy_adapts_sigma():
    assert [w.adapts_sigma for w in WEIGHTINGS] == [False, False, False, False, True, False]


def test_weightings_are_compared_by_value_and_cannot_be_changed():
    assert Mppi(temperature=2.0) == Mppi(temperature=2.0)
    with pytest.raises(AttributeError):
        Mppi().temperature = 3.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Mppi(temperature=0.0), "temperature"),
        (lambda: Mppi(temperature=float("nan")), "temperature"),
        (lambda: Mppi(beta_bounds=(0.0, 1.0)), "beta_bounds"),
        (lambda: Mppi(eta=(10.0, 5.0)), "eta"),
        (lambda: Mppi(target_ess=0.5), "target_ess"),
        (lambda: Mppi(adapt="sometimes"), "sometimes"),
        (lambda: CrossEntropy(elites=0), "elites"),
        (lambda: Tsallis(elites=0), "elites"),
        (lambda: Tsallis(entropic_index=1.0), "entropic_index"),
    ],
)
def test_senseless_parameters_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.gpu
@ALL
def test_a_captured_launch_replays_on_new_costs(weighting):
    need(CUDA)
    rng = np.random.default_rng(3)
    state = make_state(rng.uniform(size=(2, 300)), device="cuda:0")
    weighting.launch(state)  # load the kernels before the capture
    with wp.ScopedCapture(device="cuda:0") as capture:
        weighting.launch(state)
    cost = rng.uniform(size=(2, 300)).astype(np.float32)
    state.reset()
    state.cost.assign(cost)
    wp.capture_launch(capture.graph)
    expected = make_state(cost, device="cuda:0")
    weighting.launch(expected)
    np.testing.assert_array_equal(state.weight.numpy(), expected.weight.numpy())
