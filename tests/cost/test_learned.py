# SPDX-License-Identifier: Apache-2.0
"""The learned self collision against float64 in every engine, and weights that do not fit."""

import numpy as np
import pytest
from arms import arm_scene
from evaluating import Evaluating
from learned_weights import elbow_scene, network_output, random_network
from small_scenes import layout_of
from studies.arms.learned.self_distance import SelfDistance
from studies.arms.train_self_collision import Errors

from warpmpc import Controller, SceneError, State, Task, load_scene
from warpmpc.cost.stack import CostStack
from warpmpc.scene.model.assets import resolve_asset
from warpmpc.scene.model.trajectory import BatchSize
from warpmpc.scene.schema import Cost

SHAPE = BatchSize(1, 16, 1, 4)
SIZES = [(256, 64), (40, 24), (12, 5)]
"""The paper's, and others that are filled up."""


def learned(path, **keys) -> dict:
    return {"term": "learned_self_collision", "weights": str(path), **keys}


def written(folder, scene, sizes=(24, 16), **changes):
    """A file of random weights for a scene's robot, and what is in it."""
    weights = {**random_network(SelfDistance(scene), *sizes), **changes}
    np.savez(folder / "weights.npz", **weights)
    return folder / "weights.npz", weights


@pytest.mark.parametrize("sizes", SIZES)
@pytest.mark.parametrize("robot", ["panda", "ur10", "mobile_panda"])
def test_the_term_is_what_the_network_says(robot, sizes, tmp_path, device):
    distance = SelfDistance(arm_scene(robot))
    path, weights = written(tmp_path, arm_scene(robot), sizes)
    j = Evaluating(arm_scene(robot, cost=[learned(path, margin=0.03)]), SHAPE, device=device)
    q = np.random.default_rng(0).uniform(-2.0, 2.0, (5, SHAPE.worlds, j.layout.nq)).astype(np.float32)
    j.trajectory.joint_q.assign(q)
    wanted = np.maximum(0.03 + network_output(weights, q[1:, :, j.layout.dof_coord[distance.dofs]]), 0.0)
    np.testing.assert_allclose(j.cost()[0], wanted, rtol=1e-5, atol=2e-5)
    assert (wanted > 0.0).any()
    assert (wanted == 0.0).any()


@pytest.mark.parametrize("sizes", SIZES)
@pytest.mark.parametrize("robot", ["panda", "elbow"])
def test_baked_networks_say_the_same(robot, sizes, tmp_path, device):
    planner = {"samples": 37, "horizon": 11, "noise": {"sigma": 0.8}}

    def scene(*costs):
        if robot == "elbow":
            return elbow_scene(tmp_path, *costs, planner=planner)
        goal = {"frame": "arm/panda_link7", "position": (0.5, 0.3, 0.4)}
        return arm_scene(robot, cost=costs, planner=planner, goal=goal, success={"distance": 0.1})

    start = {"term": "distance", "between": ["goal", "arm/lower" if robot == "elbow" else "arm/panda_link7"]}
    path, weights = written(tmp_path, scene(start), sizes)
    mpc = Controller(scene(start, learned(path, margin=0.2, weight=3.0)), engine="kinematic", device=device, seed=0)
    dofs = SelfDistance(scene(start)).dofs
    for seed in range(3):
        q = np.random.default_rng(seed).uniform(-2.0, 2.0, mpc.layout.nq)
        mpc.step(State(q, np.zeros(mpc.layout.nv)))
        assert not mpc.engine.records
        rolled = mpc.engine.rollouts(range(mpc.shape.worlds)).joint_q.numpy()[1:, :, mpc.layout.dof_coord[dofs]]
        stage = 3.0 * np.maximum(0.2 + network_output(weights, rolled), 0.0)
        wanted = (stage * mpc.plan_step.grid.discount[:, None]).sum(axis=0)
        np.testing.assert_allclose(mpc.engine.total.numpy()[1], wanted, rtol=2e-5, atol=2e-4)


def stack(scene):
    return CostStack(scene, layout_of(scene), Task(scene))


def test_the_name_of_the_robot_and_its_place_do_not_matter(tmp_path):
    path, _ = written(tmp_path, elbow_scene(tmp_path))
    scene = elbow_scene(tmp_path, learned(path))
    moved = scene.robot[0].model_dump() | {"name": "other", "position": (1.0, 2.0, 0.3)}
    goal = {"frame": "other/lower", "position": (0.5, 0.0, 0.5)}
    stack(elbow_scene(tmp_path, learned(path), robot=[moved], goal=goal))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"spheres": {"lower": [(0.0, 0.0, 0.3, 0.2)]}}, "other links, shapes or limits"),
        ({"drive": {"mode": "velocity", "damping": 20.0, "limit": 3.0, "joints": ["shoulder"]}}, None),
        ({"asset": "panda.urdf"}, "a robot with other joints"),
    ],
)
def test_weights_of_another_robot_are_refused(changes, said, tmp_path):
    path, _ = written(tmp_path, elbow_scene(tmp_path))
    scene = elbow_scene(tmp_path, learned(path))
    robot = scene.robot[0].model_dump(exclude_unset=True) | changes
    frame = "arm/panda_link7" if "asset" in changes else "arm/lower"
    other = elbow_scene(tmp_path, learned(path), robot=[robot], goal={"frame": frame, "position": (0.5, 0.0, 0.5)})
    if said is None:  # which joints are driven is no matter of theirs
        stack(other)
        return
    with pytest.raises(SceneError, match=said) as error:
        stack(other)
    assert error.value.key == "cost.learned_self_collision.weights"


def test_joints_that_were_held_must_stay_where_they_were(tmp_path):
    scene = elbow_scene(tmp_path)
    weights = random_network(SelfDistance(scene, joints=["elbow"]), 8, 16)
    np.savez(tmp_path / "weights.npz", **weights)
    stack(elbow_scene(tmp_path, learned(tmp_path / "weights.npz")))
    robot = scene.robot[0].model_dump(exclude_unset=True) | {"joint_q": {"shoulder": 0.5}}
    with pytest.raises(SceneError, match="held elsewhere"):
        stack(elbow_scene(tmp_path, learned(tmp_path / "weights.npz"), robot=[robot]))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"w2": np.zeros((24, 15))}, "its weights have the shapes"),
        ({"w2": np.zeros((24, 80)), "b2": np.zeros(80), "w3": np.zeros((80, 1))}, "more than 64"),
        ({"b1": np.full(24, np.nan)}, "not finite"),
        ({"joints": np.array(["shoulder", "wrist"])}, "other joints.*wrist"),
    ],
)
def test_files_that_hold_something_else_are_refused(change, said, tmp_path):
    path, _ = written(tmp_path, elbow_scene(tmp_path), **change)
    with pytest.raises(SceneError, match=said):
        stack(elbow_scene(tmp_path, learned(path)))


def test_files_that_are_no_weights_are_refused(tmp_path):
    (tmp_path / "text.npz").write_text("weights")
    np.savez(tmp_path / "empty.npz", w1=np.zeros(3))
    for name, said in (("text.npz", "cannot be read"), ("empty.npz", "it lacks b1"), ("none.npz", "no such file")):
        with pytest.raises(SceneError, match=said):
            stack(elbow_scene(tmp_path, learned(tmp_path / name)))
    with pytest.raises(SceneError, match="no such robot") as error:
        stack(elbow_scene(tmp_path, learned(tmp_path / "empty.npz", of="leg")))
    assert error.value.key == "cost.learned_self_collision.of"


def test_the_shipped_weights_fit_the_panda_and_are_as_exact_as_the_docs_say():
    scene = load_scene("storm_reach")
    weights = learned("assets/panda_self_collision.npz")
    costs = [Cost.model_validate(weights), *scene.cost[1:]]
    stack(scene.model_copy(update={"cost": tuple(costs)}))
    distance = SelfDistance(scene)
    q = distance.draw(20_000, np.random.default_rng(123))
    with np.load(resolve_asset(weights["weights"], base=None, key="")) as data:
        errors = Errors.of(network_output(data, q), distance(q))
    assert errors.mean < 0.0012
    assert errors.near_p95 < 0.0025
    assert errors.false_free < 0.02
    assert errors.false_collision < 0.006
