# SPDX-License-Identifier: Apache-2.0
"""Runs of a flying body with a mocap body, activations, a movable obstacle, targets and scalars."""

import numpy as np
import pytest
from native_robots import QUADROTOR

import warpmpc
from warpmpc.scene.model.compiled import compile_scene

STEPS = 10


@pytest.fixture(scope="session")
def scene(tmp_path_factory) -> warpmpc.Scene:
    asset = tmp_path_factory.mktemp("quadrotor") / "quadrotor.xml"
    asset.write_text(QUADROTOR)
    data = {
        "timing": {"control_dt": 0.004, "timeout": STEPS * 0.004},
        "robot": [{"name": "r", "asset": str(asset), "keyframe": "hover"}],
        "object": [{"name": "box", "shape": "box", "size": (0.1, 0.2, 0.3), "mass": 1.0, "position": (1.5, 0.0, 2.0)}],
        "obstacle": [
            {"name": "gate", "shape": "sphere", "size": (0.1,), "position": (0.0, 3.0, 1.0), "movable": True},
            {"name": "post", "shape": "capsule", "size": (0.1, 1.2), "position": (5.0, 0.0, 1.0)},
        ],
        "scalar": {"pace": 0.5},
        "goal": {"frame": "r/frame", "position": (0.0, 0.0, 1.0)},
        "cost": [
            {"term": "distance", "between": ["r/frame", "goal"], "weight": 2.0},
            {"term": "distance", "name": "box-height", "between": ["box", "gate"], "weight": 0.5},
        ],
        "planner": {"samples": 16, "horizon": 5, "dt": 0.004},
        "plant": {"noise": {"position": 0.01}},
        "success": {"distance": 0.1},
    }
    return warpmpc.Scene.model_validate(data)


@pytest.fixture(scope="session", params=[3, 8])
def log(request, scene) -> warpmpc.RunLog:
    """Ten controls of a seed; the goal, the gate and the pace change on the way."""
    compiled = compile_scene(scene)
    controller = warpmpc.Controller(scene, engine="mujoco", device="cpu", seed=request.param, compiled=compiled)
    plant = warpmpc.Plant(scene, seed=request.param, task=controller.task, compiled=compiled)
    recorder = warpmpc.RunRecorder(plant, controller)
    for n in range(STEPS):
        if n == 4:
            controller.task["goal"] = [0.2, -0.5, 1.0, 0.0, 0.0, 0.0, 1.0]
            controller.task["gate"] = [0.5, 3.0, 1.0, 0.0, 0.0, 0.0, 1.0]
        if n == 7:
            controller.task["pace"] = 0.75
        control = controller.step(plant.observe())
        plant.apply(control)
        recorder.log(control)
    assert np.isfinite(recorder.run_log.states.joint_q).all()
    return recorder.run_log
