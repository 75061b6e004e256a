# SPDX-License-Identifier: Apache-2.0
"""An arm that is moved by all of its cost terms together, on growing steps."""

import numpy as np
import pytest
from arm_rollouts import ARM
from small_scenes import compiled, make_scene

from warpmpc import Controller, Plant, State

TERMS = {"pose", "stop", "manipulability", "joint_bounds", "null_posture", "path_deviation", "speed", "smoothness"}
COSTS = [
    {"term": "pose", "of": "arm/tip", "position": 100.0, "rotation": 15.0},
    {"term": "stop", "acceleration": 5.0, "weight": 100.0},
    {"term": "manipulability", "of": "arm/tip", "weight": 30.0},
    {"term": "joint_bounds", "acceleration": 40.0, "weight": 1.0},
    {"term": "null_posture", "of": "arm/tip"},
    {"term": "path_deviation", "of": "arm/tip", "weight": 10.0},
    {"term": "speed", "of": "arm/tip", "linear": 0.8, "angular": 3.0, "weight": 10.0},
    {"term": "smoothness", "weight": 1e-4},
]
STEPS = (0.04, 0.04, 0.04, 0.04, 0.08, 0.08, 0.12, 0.12)


@pytest.fixture(scope="module")
def scene():
    drive = {"damping": [200.0] * 4 + [50.0] * 3, "effort_limit": [87.0] * 4 + [12.0] * 3, "limit": 1.5}
    planner = {"samples": 48, "horizon": 8, "knots": 4, "dt": STEPS, "noise": {"sigma": 0.5}}
    return make_scene(
        robot=[{**ARM, "gravity_compensation": True, "armature": 0.1, "drive": drive}],
        ground=None,
        goal={"frame": "arm/tip", "position": (0.45, 0.25, 0.5), "rotation": (0.9, 0.1, 0.4, 0.2)},
        engine={"substeps": 2},
        cost=COSTS,
        planner=planner,
    )


def test_an_arm_comes_to_a_pose_and_stops(scene):
    assert {cost["term"] for cost in COSTS} == TERMS
    mpc = Controller(scene, seed=0, engine="mujoco", compiled=compiled(scene))
    plant = Plant(scene, seed=1, task=mpc.task, compiled=compiled(scene))
    error = []
    for _ in range(60):
        plant.apply(mpc.step(plant.observe()))
        assert np.isfinite(list(mpc.info.terms.values())).all()
        error.append(mpc.info.terms["pose"])
    assert np.mean(error[-5:]) < 0.25 * error[0]
    assert np.abs(plant.state.joint_qd).max() < 0.5


def test_environments_are_judged_by_goals_of_their_own(scene):
    batch = Controller(scene, seed=3, envs=2, engine="mujoco", compiled=compiled(scene))
    alone = [Controller(scene, seed=3, engine="mujoco", compiled=compiled(scene)) for _ in range(2)]
    goals = batch.task["goal"]
    goals[1, :3] = [0.3, -0.4, 0.6]
    batch.task["goal"] = goals
    rng = np.random.default_rng(0)
    for step in range(3):
        q = (np.array(ARM["joint_q"]) + rng.uniform(-0.2, 0.2, (2, 7))).astype(np.float32)
        qd = rng.uniform(-0.3, 0.3, (2, 7)).astype(np.float32)
        command = batch.step(State(q, qd, 0.04 * step))
        for e, controller in enumerate(alone):
            controller.task["goal"] = goals[e]
            np.testing.assert_array_equal(command[e], controller.step(State(q[e], qd[e], 0.04 * step)))
            assert batch.info[e].terms == controller.info.terms
    assert not np.array_equal(*command)
