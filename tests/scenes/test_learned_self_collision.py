# SPDX-License-Identifier: Apache-2.0
"""A Panda that goes to postures in which its links are close: what keeps them apart in the plant.

Slow ones by hand: pytest -m slow tests/scenes/test_learned_self_collision.py
"""

import numpy as np
import pytest
import warp as wp
from studies.arms.learned.self_distance import SelfDistance

from warpmpc import Controller, Plant, load_scene
from warpmpc.kernels.geometry.kinematics import forward_kinematics_kernel
from warpmpc.scene.model.joints import joint_table
from warpmpc.scene.schema import Cost

LEARNED = {
    "term": "learned_self_collision",
    "weights": "assets/panda_self_collision.npz",
    "margin": 0.01,
    "weight": 5000.0,
}


def tool_pose(distance: SelfDistance, q: np.ndarray) -> np.ndarray:
    """Pose of the tool in a configuration ``[7]``."""
    layout = distance.layout
    joint_q = layout.joint_q.copy()
    joint_q[layout.dof_coord[distance.dofs]] = q
    body_q = wp.zeros((1, 1, layout.nb), dtype=wp.transform, device="cpu")
    body_qd = wp.zeros(body_q.shape, dtype=wp.spatial_vector, device="cpu")
    inputs = [wp.array(a[None, None], dtype=float, device="cpu") for a in (joint_q, np.zeros(layout.nv))]
    table = joint_table(layout, "cpu")
    wp.launch(forward_kinematics_kernel, (1, 1), [table, *inputs], [body_q, body_qd], device="cpu")
    frame = layout.frame("panda/tool")
    pose = wp.transform(*body_q.numpy()[0, 0, layout.frame_body[frame]]) * wp.transform(*layout.frame_pose[frame])
    return np.array(pose).reshape(-1)


def close_pose(distance: SelfDistance, rng: np.random.Generator) -> np.ndarray:
    """Where the tool is in a drawn posture with 3 to 6 cm between some links."""
    middle = 0.5 * (distance.lower + distance.upper)
    while True:
        q = (middle + 0.9 * (distance.draw(1, rng) - middle)).astype(np.float32)
        pose = tool_pose(distance, q[0])
        if -0.06 < distance(q)[0] < -0.03 and pose[2] > 0.1:
            return pose


def deepest(kind: str, seed: int) -> float:
    """Deepest penetration of two links' spheres on the way to a drawn pose, in the plant [m]."""
    scene = load_scene("storm_reach")
    distance, rng = SelfDistance(scene), np.random.default_rng([77, seed])
    goal = [close_pose(distance, rng) for _ in range(2)][1]
    others = [cost for cost in scene.cost if cost.term not in ("self_collision", "world_collision")]
    own = {
        "none": [],
        "geometric": [cost for cost in scene.cost if cost.term == "self_collision"],
        "learned": [Cost.model_validate(LEARNED)],
    }
    changes = {
        "cost": (*others, *own[kind]),
        "goal": scene.goal.model_copy(update={"position": tuple(goal[:3]), "rotation": tuple(goal[3:])}),
        "obstacle": (),
        "ground": None,
        "timing": scene.timing.model_copy(update={"timeout": 4.0}),
    }
    scene = scene.model_copy(update=changes)
    mpc = Controller(scene, engine="kinematic", device="cpu", seed=seed)
    plant, visited = Plant(scene, seed=seed, task=mpc.task), []
    while not plant.done:
        state = plant.observe()
        visited.append(state.joint_q[distance.layout.dof_coord[distance.dofs]])
        plant.apply(mpc.step(state))
    mpc.engine.close()
    return float(distance(np.array(visited, dtype=np.float32)).max())


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_links_meet_without_a_term_and_stay_apart_with_either(seed):
    assert deepest("none", seed) > 0.03
    assert deepest("geometric", seed) < -0.005
    assert deepest("learned", seed) < -0.005
