# SPDX-License-Identifier: Apache-2.0
"""Shipped scenes that solvers of Newton step, in closed loop: a few controls on the CPU, to the goal on a GPU."""

import numpy as np
import pytest
from needs import CUDA, need

from warpmpc import Controller, Plant, load_scene
from warpmpc.scene.model.compiled import compile_scene

SMALL = ["planner.samples=8", "planner.horizon=4", "randomize.box={mass = {uniform = 0.3}, friction = {uniform = 0.3}}"]
IN_FRONT = ["robot.base.joint_q=[1.54, 2.0, 0.0]"]  # the base touches the box at once


def test_newton_plans_as_mujoco_does_from_every_observed_state():
    """Newton's model, states, controls and SolverMuJoCo against MuJoCo C, while the base pushes the box."""
    scene = load_scene("omni_push_box:newton", overrides=[*SMALL, *IN_FRONT])
    compiled = compile_scene(scene)
    newton, mujoco = (
        Controller(scene, engine=engine, device="cpu", compiled=compiled, seed=1) for engine in ("auto", "mujoco")
    )
    assert newton.engine.name == "newton"
    plant = Plant(scene, compiled=compiled)
    for _ in range(4):
        state = plant.observe()
        expected, found = mujoco.step(state), newton.step(state)
        np.testing.assert_allclose(found, expected, atol=5e-3)
        assert newton.info.cost == pytest.approx(mujoco.info.cost, rel=1e-3)
        start = newton.engine.simulator.trajectory.joint_q.numpy()[0]
        np.testing.assert_allclose(start, np.tile(state.joint_q, (len(start), 1)), atol=1e-6)
        plant.apply(expected)
    assert newton.info.diverged_worlds == 0


def test_xpbd_sweeps_the_pile_towards_its_place():
    scene = load_scene(
        "omni_sweep_cubes:xpbd",
        overrides=["planner.samples=8", "planner.lookahead=0.4", "robot.base.joint_q=[0.22, 0.0, 0.0]"],
    )
    compiled = compile_scene(scene)
    controller = Controller(scene, device="cpu", compiled=compiled, seed=0)
    assert controller.engine.name == "newton"
    plant = Plant(scene, compiled=compiled)
    layout = compiled.layout
    ahead = [layout.joint_q_start[layout.entity(f"cube_{i}").joints[0]] for i in range(1, 5)]  # x of each cube
    before = plant.observe().joint_q[ahead].copy()
    for _ in range(9):
        plant.apply(controller.step(plant.observe()))
        assert controller.info.diverged_worlds == 0
    moved = plant.observe().joint_q[ahead] - before
    assert (moved > 0.05).all()  # 0.8 m/s at most, for a third of a second


@pytest.mark.gpu
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", ["omni_push_box:newton", "omni_sweep_cubes:xpbd"])
def test_a_captured_graph_of_newtons_steps_reaches_the_goal(name, seed):
    need(CUDA)
    scene = load_scene(name)
    compiled = compile_scene(scene)
    controller = Controller(scene, device="cuda:0", compiled=compiled, seed=seed)
    plant = Plant(scene, compiled=compiled, seed=seed)
    while not plant.done:
        plant.apply(controller.step(plant.observe()))
    assert controller.engine.name == "newton"
    assert controller.graph.captured is not None
    assert plant.reason == "goal reached"
    assert controller.info.diverged_worlds == 0
