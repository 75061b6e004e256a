# SPDX-License-Identifier: Apache-2.0
"""Derivatives and what is planned with them on a GPU, beside the CPU: pytest -m gpu tests/planner/derivatives."""

from dataclasses import replace

import numpy as np
import pytest
from needs import CUDA, need
from stepping import stepping

from warpmpc import Controller, State, load_scene
from warpmpc.planner.derivatives.rollouts import Policy
from warpmpc.scene.overrides import with_values

pytestmark = pytest.mark.gpu
STEPS = 6
SIZES = {"planner.horizon": STEPS, "planner.knots": STEPS, "planner.samples": 64, "engine.substeps": 1}
PLACES = [("cartpole_swingup", "fused"), ("panda_reach", "fused"), ("humanoid_stand", "fused")]
PLACES += [("cartpole_swingup", "mujoco_warp"), ("storm_reach", "kinematic")]


@pytest.fixture(scope="module", params=PLACES, ids=["-".join(place) for place in PLACES])
def pair(request):
    """The same worlds on the CPU and on the GPU, and a rollout to look at."""
    need(CUDA)
    name, engine = request.param
    scene = with_values(load_scene(name), SIZES)
    cpu, gpu = (stepping(scene, engine, candidates=5, device=device) for device in ("cpu", "cuda:0"))
    rng, layout = np.random.default_rng(0), cpu.controller.layout
    share = rng.uniform(0.4, 0.6, (1, STEPS, layout.nu))
    control = layout.control_lower + share * (layout.control_upper - layout.control_lower)
    return cpu, gpu, control.astype(np.float32).astype(float)


def outcome_of(s, control):
    gain = np.zeros((1, STEPS, control.shape[2], s.tangent.size))
    policy = Policy(np.ones((1, STEPS, s.tangent.width)), control, 0.05 * np.ones_like(control), gain)
    return s.rollouts(s.rollouts.worlds.observed(), control[:, 0], [policy], np.linspace(0.0, 1.0, 5), 0.0)


def test_policies_roll_out_as_on_the_cpu_and_stay_the_same_as_a_graph(pair):
    cpu, gpu, control = pair
    wanted = outcome_of(cpu, control)
    found = [outcome_of(gpu, control) for _ in range(3)]  # launch by launch, captured, replayed
    for outcome in found:
        np.testing.assert_array_equal(outcome.state, found[0].state)
        np.testing.assert_array_equal(outcome.cost, found[0].cost)
    np.testing.assert_array_equal(found[0].control, wanted.control)
    np.testing.assert_allclose(found[0].state, wanted.state, atol=2e-3)
    np.testing.assert_allclose(found[0].cost, wanted.cost, rtol=2e-3)
    assert len(np.unique(found[0].cost)) == 5


def test_derivatives_are_those_of_the_cpu(pair):
    cpu, gpu, control = pair
    states = outcome_of(cpu, control).state[:, 0, :-1]
    wanted = cpu.differences(states, control, control[:, 0])
    for _ in range(3):
        found = gpu.differences(states, control, control[:, 0])
        for name in ("a", "b", "c", "d", "residual"):
            one, other = getattr(found, name), getattr(wanted, name)
            # both in single precision: numbers near 10, such as velocities are, are 1e-6 apart, and steps are 1e-4
            np.testing.assert_allclose(one, other, atol=2e-2 * max(1.0, np.abs(other).max()), err_msg=name)


@pytest.mark.parametrize("method", ["gradient_descent", "ilqg", "ilqs"])
def test_a_pole_is_planned_for_as_on_the_cpu(method):
    """Ten plans for a pole that hangs, each as good as the CPU's."""
    need(CUDA)
    cost = {}
    for device in ("cpu", "cuda:0"):
        scene = with_values(load_scene("cartpole_swingup"), {"planner.method": method, "planner.samples": 64})
        controller = Controller(scene, device=device, engine="fused", seed=0)
        for i in range(10):
            controller.step(replace(State.start(controller.layout), time=0.02 * i))
        cost[device] = float(controller.info.cost)
    assert cost["cuda:0"] == pytest.approx(cost["cpu"], rel=0.05)
