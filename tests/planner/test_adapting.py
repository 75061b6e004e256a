# SPDX-License-Identifier: Apache-2.0
"""Covariances that are adapted in whole plans: mean first, then the covariance about it, in every round."""

import numpy as np
import pytest
from planning import Planning, limited_mean

from warpmpc import SceneError
from warpmpc.planner.strategy import proposal

FORMS = ("diagonal", "knots", "full", "full_knots")
MPPI = {"method": "mppi", "samples": 24, "horizon": 6, "temperature": {"initial": 0.05, "eta": None}}
ALPHA_MEAN, ALPHA_SIGMA, KAPPA, FLOOR = 0.9, 0.7, 0.004, 0.05


def rounds(planning: Planning):
    """Plan once, round by round: knots [E, S, P, nu] and costs [E, S] of each, in float64."""
    plan = planning.plan
    planning.costs.refresh()
    plan.state.joint_q.assign(planning.q)
    plan.state.elapsed.fill_(planning.elapsed)
    planning.strategy.shift()
    for i in range(len(planning.strategy.population)):
        planning.strategy.advance(i)
        plan.engine.evaluate(proposal(planning.strategy, i))
        yield planning.knots.astype(np.float64), planning.cost.astype(np.float64)
        planning.strategy.update(i)


def drawn_with(planning: Planning) -> np.ndarray:
    """Covariance of every knot ``[E, P, nu, nu]``."""
    covariance = planning.strategy.distribution.covariance
    if covariance.full:
        factor = covariance.factor.numpy().astype(np.float64).reshape(len(planning.mean), -1, 3, 3)
        return np.broadcast_to(factor @ factor.swapaxes(2, 3), (*planning.mean.shape, 3))
    return planning.sigma.astype(np.float64)[..., None] ** 2 * np.eye(3)


def adapted(form: str, before: np.ndarray, deviation: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Bhardwaj et al. 2021, Eq. 5, of deviations [E, S, P, nu] from the new mean."""
    target = np.einsum("es,espu,espv->epuv", weight, deviation, deviation)
    if form.startswith("full"):
        target = target.mean(axis=1, keepdims=True) if form == "full" else target
        return (1.0 - ALPHA_SIGMA) * before + ALPHA_SIGMA * target
    variance = np.einsum("epuu->epu", target)
    axes = {"diagonal": (1,), "knots": ()}[form]
    shared = variance.mean(axis=axes, keepdims=True) if axes else variance
    variance = (1.0 - ALPHA_SIGMA) * np.einsum("epuu->epu", before) + ALPHA_SIGMA * shared
    return np.maximum(variance, FLOOR**2)[..., None] * np.eye(3)


@pytest.mark.parametrize("anneal", [None, (0.6, 0.8)])
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("seed", range(2))
def test_plans_of_three_rounds_match_the_reference(form, seed, anneal):
    planner = {
        **MPPI,
        "iterations": 3,
        "step_size": ALPHA_MEAN,
        "sigma_min": FLOOR if not form.startswith("full") else 1e-3,
        "covariance": {"form": form, "step_size": ALPHA_SIGMA, "kappa": KAPPA},
        "noise": {"sigma": 0.4, "shape": "identity", "anneal": anneal},
    }
    planning = Planning(envs=2, seed=seed, planner=planner)
    planning.q[1, :2] = [0.5, 1.0]
    schedule = planning.strategy.distribution.covariance.schedule.numpy().astype(np.float64)
    mean, covariance = planning.mean.astype(np.float64), drawn_with(planning)
    for n in range(3):
        if n:  # a control later, the last one held
            mean = np.concatenate([mean[:, 1:], mean[:, -1:]], axis=1)
            if form in ("knots", "full_knots"):
                covariance = np.concatenate([covariance[:, 1:], covariance[:, -1:]], axis=1)
            covariance = covariance + KAPPA * np.eye(3)
        for i, (knots, cost) in enumerate(rounds(planning)):
            np.testing.assert_allclose(knots[:, 0], mean, atol=1e-5)
            factor = schedule[i][:, None, None] * np.linalg.cholesky(covariance)
            drawn = mean[:, None] + np.einsum("epuv,espv->espu", factor, planning.noise)
            np.testing.assert_allclose(knots[:, 2:], drawn[:, 2:].clip(*planning.limits), atol=3e-4)  # 1 is null
            drawn[:, :2] = knots[:, :2]
            drawn = np.where(knots == drawn.clip(*planning.limits).astype(np.float32), drawn, knots)
            weight = np.exp(-(cost - cost.min(axis=1, keepdims=True)) / 0.05)
            weight /= weight.sum(axis=1, keepdims=True)
            variance = np.arange(weight.shape[1]) != 1
            mean = limited_mean(drawn, weight, mean, planning.limits, alpha=ALPHA_MEAN, variance=variance)
            deviation = (knots - mean[:, None]) / schedule[i][:, None]
            covariance = adapted(form, covariance, deviation, weight)
        np.testing.assert_allclose(planning.mean, mean, atol=1e-5)
        np.testing.assert_allclose(drawn_with(planning), covariance, rtol=2e-3, atol=2e-5)
    assert np.abs(mean[0] - mean[1]).max() > 0.05


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("method", ["mppi", "predictive_sampling", "cem"])
def test_every_method_adapts_and_returns_to_the_start(method, form):
    planner = {"method": method, "covariance": {"form": form}, "elites": 12, "temperature": {"initial": 0.05}}
    planning = Planning(planner=planner)
    start = drawn_with(planning)
    first = planning(4)
    assert np.all(np.isfinite(first))
    assert not np.allclose(drawn_with(planning), start, rtol=0.1)
    planning.plan.reset()
    np.testing.assert_array_equal(drawn_with(planning), start)
    np.testing.assert_array_equal(planning(4), first)


@pytest.mark.parametrize("form", FORMS)
def test_a_cheaper_plan_is_found_with_every_form(form):
    planning = Planning(planner={**MPPI, "samples": 48, "covariance": {"form": form, "kappa": 0.005}})
    planning()
    at_rest = planning.cost[0, 0]
    planning(15)
    assert planning.cost[0, 0] < 0.95 * at_rest


@pytest.mark.parametrize("form", [*FORMS, "fixed"])
def test_the_threads_of_the_engine_change_no_bit_of_a_covariance(form):
    def plan(threads: int) -> tuple[np.ndarray, np.ndarray]:
        planner = {**MPPI, "iterations": 2, "covariance": {"form": form}, "noise": {"sigma": 0.4, "constant": 0.2}}
        planning = Planning(envs=3, engine={"threads": threads}, planner=planner)
        planning.q[:, 1] = [0.0, 0.3, -0.5]
        commands = planning(4)
        planning.engine.close()
        return commands, drawn_with(planning)

    for a, b in zip(plan(1), plan(3), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("form", ["full", "full_knots"])
def test_the_covariance_of_an_environment_where_every_sample_diverged_stays(form):
    planning = Planning(envs=2, planner={**MPPI, "covariance": {"form": form}})
    planning(2)
    before = drawn_with(planning)
    planning.qd[1, 0] = np.nan
    planning()
    if form == "full":
        np.testing.assert_array_equal(drawn_with(planning)[1], before[1])
    else:  # it moves on all the same
        expected = np.concatenate([before[1, 1:], before[1, -1:]])
        np.testing.assert_allclose(drawn_with(planning)[1], expected, rtol=1e-4, atol=1e-7)
    assert not np.allclose(drawn_with(planning)[0], before[0])


def test_cem_may_have_a_fixed_covariance():
    planning = Planning(planner={"method": "cem", "covariance": {"form": "fixed"}})
    planning(3)
    assert np.all(planning.sigma == 0.5)


@pytest.mark.parametrize(("redraw", "changes"), [({}, True), ({"redraw": True}, True), ({"redraw": False}, False)])
def test_noise_of_an_adapted_covariance_is_redrawn_unless_the_scene_says_no(redraw, changes):
    """STORM draws its Halton points once and adapts all the same."""
    noise = {"sigma": (0.5,), **redraw}
    planning = Planning(planner={**MPPI, "covariance": {"form": "diagonal"}, "noise": noise})
    planning()
    first = planning.strategy.noise.noise.numpy().copy()
    planning()
    assert np.array_equal(first, planning.strategy.noise.noise.numpy()) is not changes


@pytest.mark.parametrize(
    ("planner", "message"),
    [
        ({"covariance": {"kappa": 0.1}}, "kappa is of an adapted covariance"),
        ({"covariance": {"form": "fixed", "step_size": 0.5}}, "step_size is of an adapted covariance"),
        ({"covariance": {"form": "full", "kappa": (0.1, 0.2)}}, r"planner.covariance.kappa: needs 1 or 3 values"),
        ({"noise": {"shape": "bspline", "knots": 9}}, r"planner.noise: noise_knots must be between 1 and 8"),
        ({"noise": {"shape": "comb", "comb": (0.0, 0.5, 0.5)}}, r"planner.noise: a knot without noise"),
    ],
)
def test_what_contradicts_itself_is_refused(planner, message):
    with pytest.raises(SceneError, match=message):
        Planning(planner=planner)
