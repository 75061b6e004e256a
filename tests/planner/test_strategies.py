# SPDX-License-Identifier: Apache-2.0
"""Strategies by name: a user's own one plans like those that ship."""

import numpy as np
import pytest
import warp as wp
from small_scenes import compiled, make_scene

from warpmpc import Controller, Plant, State
from warpmpc.planner.step import STRATEGIES, register


class Fixed:
    """Tries the same constant controls at every plan, on a ring around zero, and takes the best one."""

    def __init__(self, scene, layout, state, spline, limits, cost, *, seed=0):
        self.cost = cost
        (envs, samples), knots, nu = cost.shape, len(spline.time), layout.nu
        self.population = (samples,)
        angle = np.linspace(0.0, 2.0 * np.pi, samples, endpoint=False)
        tried = np.zeros((envs, samples, knots, nu), dtype=np.float32)
        tried[..., 0], tried[..., 1] = np.cos(angle)[None, :, None], np.sin(angle)[None, :, None]
        self.knots = wp.array(tried, dtype=float, device=cost.device)
        self.mean = wp.zeros((envs, knots, nu), dtype=float, device=cost.device)
        self.offset, self.beta, self.eta = (wp.zeros(envs, dtype=float, device=cost.device) for _ in range(3))
        self.eta.fill_(1.0)

    def shift(self):
        pass

    def advance(self, iteration):
        pass

    def sample_knots(self, iteration, first, count):
        pass

    def update(self, iteration):
        arrays = {"inputs": [self.cost, self.knots], "outputs": [self.mean]}
        wp.launch(take_best_kernel, self.mean.shape, **arrays, device=self.mean.device)

    def reset(self):
        self.mean.zero_()


@wp.kernel
def take_best_kernel(
    # inputs
    cost: wp.array2d[float],  # [E, S]
    knots: wp.array4d[float],  # [E, S, P, nu]
    # outputs
    mean: wp.array3d[float],  # [E, P, nu]
):
    """One number of one knot of the best sample."""
    e, p, u = wp.tid()
    best = wp.int32(0)
    for s in range(cost.shape[1]):
        if cost[e, s] < cost[e, best]:
            best = s
    mean[e, p, u] = knots[e, best, p, u]


@pytest.fixture
def fixed():
    register("fixed", Fixed)
    yield "fixed"
    del STRATEGIES["fixed"]


def test_a_strategy_of_ones_own_drives_to_the_goal(fixed):
    scene = make_scene(planner={"samples": 16, "horizon": 4})
    controller = Controller(scene, strategy=fixed, compiled=compiled(scene))
    assert isinstance(controller.plan_step.strategy, Fixed)
    plant = Plant(scene, compiled=compiled(scene), task=controller.task)
    while not plant.done:
        u = controller.step(plant.observe())
        assert np.hypot(u[0], u[1]) == pytest.approx(1.0, rel=1e-5)  # its samples and nobody else's
        plant.apply(u)
    assert plant.reason == "goal reached"


@pytest.mark.parametrize("method", ["mppi", "predictive_sampling", "cem"])
def test_a_scene_names_the_strategy_by_its_method(method, monkeypatch):
    made = []

    def make(*args, **keys):
        made.append((args[0].planner.method, keys))
        return Fixed(*args, **keys)

    monkeypatch.setitem(STRATEGIES, method, make)
    scene = make_scene(planner={"samples": 8, "horizon": 4, "method": method})
    controller = Controller(scene, seed=3, compiled=compiled(scene))
    controller.step(State.start(controller.layout))
    assert made == [(method, {"seed": 3})]


def test_a_strategy_that_tries_more_samples_than_there_are_is_refused(monkeypatch):
    def greedy(*args, **keys):
        strategy = Fixed(*args, **keys)
        strategy.population = (8, 16)
        return strategy

    monkeypatch.setitem(STRATEGIES, "mppi", greedy)
    scene = make_scene(planner={"samples": 8, "horizon": 4})
    with pytest.raises(ValueError, match="strategy Fixed: its population has 16 samples"):
        Controller(scene, compiled=compiled(scene))


def test_a_name_that_nobody_registered_is_told_with_those_that_are(fixed):
    scene = make_scene()
    with pytest.raises(ValueError, match=r"no strategy 'fixd'; there is: auto, mppi.*fixed"):
        Controller(scene, strategy="fixd", compiled=compiled(scene))


def test_a_name_is_given_once(fixed):
    with pytest.raises(ValueError, match="strategy 'fixed' already"):
        register("fixed", Fixed)


SOLVING = {
    "tsallis": {"method": "tsallis"},
    "dial": {"method": "dial"},
    "averse steps": {"stage_risk": 0.5},
    "bounded steps": {"stage_risk": -0.5},
    **{risk: {"risk": risk, "domains": 2, "samples": 24} for risk in ("best", "var", "exponential")},
}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", SOLVING)
def test_every_strategy_and_risk_drives_to_the_goal(name, seed):
    scene = make_scene(planner={"samples": 32, "horizon": 6, **SOLVING[name]}, engine={"name": "mujoco", "threads": 1})
    controller = Controller(scene, seed=seed, compiled=compiled(scene))
    plant = Plant(scene, seed=seed, compiled=compiled(scene), task=controller.task)
    while not plant.done:
        plant.apply(controller.step(plant.observe()))
    assert plant.reason == "goal reached"
