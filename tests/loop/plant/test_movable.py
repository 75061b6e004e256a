# SPDX-License-Identifier: Apache-2.0
"""Obstacles that move with the task: in the plant, in rollouts, and in what plans cost."""

import numpy as np
import pytest
import warp as wp
from small_scenes import WALL, compiled, layout_of, make_engine, make_scene

from warpmpc import Controller, Plant, SceneError, Task
from warpmpc.engine.mujoco_warp import MujocoWarpSimulator
from warpmpc.engine.newton import NewtonSimulator
from warpmpc.scene.check import check_scene
from warpmpc.scene.model.pairs import Pair
from warpmpc.scene.model.trajectory import BatchSize
from warpmpc.scene.task.observed import ObservedState

GATE = {**WALL, "name": "gate", "rotation": (0.0, 0.0, 0.6, 0.8), "position": (3.0, 0.0, 0.2), "movable": True}
AHEAD = (0.6, 0.0, 0.2, 0.0, 0.0, 0.0, 1.0)
"""Where the gate blocks the way along x: its near side is at 0.5 m, the disc's radius is 0.2 m."""
FORWARD = np.array([1.0, 0.0, 0.0])


def gate_scene(**sections):
    cost = [{"term": "distance", "between": ["base/centre", "goal"]}, {"term": "world_collision", "margin": 0.05}]
    return make_scene(**{"obstacle": [WALL, GATE], "cost": cost, "plant": {"randomize": False}, **sections})


def drive(plant: Plant, steps: int) -> float:
    for _ in range(steps):
        plant.apply(FORWARD)
    return float(plant.state.joint_q[0])


def test_a_plants_obstacle_is_where_the_task_puts_it():
    plant = Plant(gate_scene())
    assert drive(plant, 20) > 0.5  # the way is free
    plant.reset()
    plant.task["gate"] = AHEAD
    assert drive(plant, 20) < 0.35
    assert plant.contact.forces["base-gate"] > 1.0
    plant.task["gate"] = (3.0, *AHEAD[1:])
    assert drive(plant, 20) > 0.6


def test_a_gate_at_rest_is_as_good_as_one_that_cannot_move():
    moved, still = (
        Plant(gate_scene(obstacle=[{**GATE, "position": (0.8, 0.1, 0.2), "movable": m}])) for m in (True, False)
    )
    assert drive(moved, 25) == pytest.approx(drive(still, 25), abs=1e-5)
    assert moved.contact.max_force == pytest.approx(still.contact.max_force, rel=1e-3)
    assert moved.contact.max_force > 1.0


def test_each_plant_of_a_batch_has_its_own():
    plants = Plant(gate_scene(), envs=2)
    plants._worlds.task["gate"] = np.array([AHEAD, (3.0, *AHEAD[1:])])
    for _ in range(20):
        plants.apply(np.tile(FORWARD, (2, 1)))
    near, far = plants.state.joint_q[:, 0]
    assert near < 0.35 < 0.5 < far


def test_plans_follow_an_obstacle_from_one_to_the_next(device):
    scene = gate_scene(planner={"samples": 64, "horizon": 10})
    mpc = Controller(scene, device=device, engine="mujoco" if device == "cpu" else "mujoco_warp", seed=0)
    state = Plant(scene).observe()
    for _ in range(3):
        mpc.step(state)
    graph = mpc.graph.captured
    assert mpc.info.terms["world_collision"] == 0.0
    mpc.task["gate"] = (0.1, *AHEAD[1:])  # on the disc
    mpc.step(state)
    assert mpc.info.terms["world_collision"] > 0.1
    mpc.task["gate"] = (3.0, *AHEAD[1:])
    mpc.step(state)
    assert mpc.info.terms["world_collision"] == 0.0
    assert mpc.graph.captured is graph


def rolled_out(engine, scene, gate: tuple) -> np.ndarray:
    """Where the disc is after 20 steps forward."""
    task, device = Task(scene), engine.device
    task["gate"] = gate
    engine.clone(ObservedState.allocate(layout_of(scene), task, device))
    control = np.tile(FORWARD.astype(np.float32), (20, engine.shape.worlds, 1))
    engine.rollout(wp.array(control, dtype=float, device=device))
    return engine.trajectory.joint_q.numpy()[-1, :, 0]


def warp_engine(scene) -> MujocoWarpSimulator:
    device, pairs = ("cuda:0" if wp.is_cuda_available() else "cpu"), (Pair("base", "gate"),)
    shape, model = BatchSize(1, 2, 1, 20), compiled(scene)
    return MujocoWarpSimulator(scene, model, shape, substeps=[2] * 20, timestep=0.02, pairs=pairs, device=device)


@pytest.mark.parametrize("make", [lambda scene: make_engine(scene, samples=2, horizon=20), warp_engine])
def test_rollouts_run_into_obstacles_where_the_task_has_them(make):
    scene = gate_scene()
    engine = make(scene)
    assert (rolled_out(engine, scene, AHEAD) < 0.35).all()
    assert (rolled_out(engine, scene, (3.0, *AHEAD[1:])) > 0.5).all()


def test_newton_says_that_it_does_not_move_obstacles():
    scene = gate_scene(engine={"name": "newton"})
    with pytest.raises(SceneError, match="does not move obstacles") as error:
        NewtonSimulator(scene, compiled(scene), BatchSize(1, 1, 1, 2), substeps=[1, 1], timestep=0.02, device="cpu")
    assert error.value.key == "obstacle.gate.movable"


def test_a_movable_obstacles_name_is_one_of_the_tasks():
    with pytest.raises(SceneError, match="taken by another"):
        check_scene(gate_scene(scalar={"gate": 1.0}))
    with pytest.raises(ValueError, match="a plane cannot move"):
        gate_scene(obstacle=[{"name": "floor", "shape": "plane", "movable": True}])


def test_success_may_ask_for_clearance_from_what_moves():
    plant = Plant(gate_scene(success={"conditions": {"term": "world_collision", "below": 0.001}}))
    plant.task["gate"] = (0.24, *AHEAD[1:])  # 4 cm from the disc
    plant.apply(0.0 * FORWARD)
    assert not plant.success
    plant.task["gate"] = (3.0, *AHEAD[1:])
    plant.apply(0.0 * FORWARD)
    assert plant.success
