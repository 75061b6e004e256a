# SPDX-License-Identifier: Apache-2.0
"""Training on the geometric distance: labels, gradients, and an arm of two joints that is learned in seconds."""

import numpy as np
import pytest
import warp as wp
from arms import arm_scene
from evaluating import Evaluating
from learned_weights import elbow_scene
from studies.arms.learned.network import Network
from studies.arms.learned.self_distance import SelfDistance
from studies.arms.train_self_collision import Errors, trained

from warpmpc.kernels.geometry.kinematics import forward_kinematics_kernel
from warpmpc.scene.model.joints import joint_table
from warpmpc.scene.model.trajectory import BatchSize

SHAPE = BatchSize(1, 64, 1, 4)


def geometric(scene, distance: SelfDistance, q: np.ndarray) -> np.ndarray:
    """What the scene's one cost term says of configurations ``[T · W, joints]``."""
    j = Evaluating(scene, SHAPE)
    full = np.tile(j.layout.joint_q, (5, SHAPE.worlds, 1))
    full[1:, :, j.layout.dof_coord[distance.dofs]] = q.reshape(4, SHAPE.worlds, -1)
    out = j.trajectory
    out.joint_q.assign(full)
    inputs = [joint_table(j.layout, "cpu", worlds=SHAPE.worlds), out.joint_q, out.joint_qd]
    wp.launch(forward_kinematics_kernel, full.shape[:2], inputs, [out.body_q, out.body_qd], device="cpu")
    return j.cost()[0].ravel()


@pytest.mark.parametrize("robot", ["panda", "ur10", "mobile_panda"])
def test_labels_are_the_geometric_term(robot):
    scene = arm_scene(robot, cost=[{"term": "self_collision", "margin": 0.05}])
    distance = SelfDistance(scene)
    q = distance.draw(4 * SHAPE.worlds, np.random.default_rng(0))
    d = distance(q)
    np.testing.assert_allclose(geometric(scene, distance, q), np.maximum(0.05 + d, 0.0), atol=2e-6)
    assert (d > 0.0).any()
    assert (d < -0.05).any()


def test_joints_that_move_no_link_against_another_are_left_out():
    names = SelfDistance(arm_scene("mobile_panda")).names
    assert not any("base" in name or name in "xy" for name in names)
    assert set(SelfDistance(arm_scene("panda")).names) <= {f"panda_joint{i}" for i in range(1, 8)}


def test_gradients_are_those_of_small_differences():
    rng = np.random.default_rng(0)
    network = Network.drawn((4, 8, 6, 1), rng)
    for values in (network.weights, network.biases):
        values[:] = [2.0 * v.astype(np.float64) + rng.normal(0.0, 0.5, v.shape) for v in values]
    x = rng.normal(size=(32, 4))
    found = network.gradient(x, lambda out: out)
    for value, gradient in zip([*network.weights, *network.biases], found, strict=True):
        at = np.unravel_index(np.abs(gradient).argmax(), gradient.shape)
        ends = []
        for way in (1e-6, -2e-6):
            value[at] += way
            ends.append(0.5 * (network(x) ** 2).sum())
        value[at] += 1e-6
        assert (ends[0] - ends[1]) / 2e-6 == pytest.approx(gradient[at], rel=1e-4)


def test_normalisation_moves_into_the_weights():
    rng = np.random.default_rng(1)
    network, x = Network.drawn((3, 8, 8, 1), rng), rng.normal(size=(16, 3)).astype(np.float32)
    mean, deviation = rng.normal(size=3), rng.uniform(0.5, 2.0, 3)
    wanted = 0.3 * network(((x - mean) / deviation).astype(np.float32))
    np.testing.assert_allclose(network.normalized(mean, deviation, 0.3)(x), wanted, atol=1e-5)


def test_errors_tell_both_kinds_of_mistakes():
    wanted = np.array([0.1, 0.01, -0.01, -0.1, -0.2])
    found = np.array([0.1, -0.02, 0.02, -0.1, -0.1])
    errors = Errors.of(found, wanted)
    assert errors.mean == pytest.approx(0.032)
    assert errors.near == pytest.approx(0.03)
    assert (errors.false_free, errors.unseen) == (0.5, 0.01)
    assert errors.false_collision == pytest.approx(1.0 / 3.0)


def test_two_joints_are_learned_in_seconds_and_judged_as_geometry_does(tmp_path):
    distance = SelfDistance(elbow_scene(tmp_path))
    result = trained(distance, hidden=(32, 16), configurations=20_000, steps=2500, batch=256, held_out=5000)
    errors = result.errors
    assert errors.mean < 0.01  # where the links are half a metre apart, too
    assert errors.near < 0.006
    assert errors.false_free < 0.03
    assert errors.false_collision < 0.01
    result.save(tmp_path / "elbow.npz")
    # the term in a scene, on configurations that are new to it
    scene = elbow_scene(tmp_path, {"term": "learned_self_collision", "weights": str(tmp_path / "elbow.npz")})
    q = distance.draw(4 * SHAPE.worlds, np.random.default_rng(7))
    off = np.abs(geometric(scene, distance, q) - np.maximum(distance(q), 0.0))
    assert off.mean() < 0.003


def test_the_same_seed_gives_the_same_weights(tmp_path):
    distance = SelfDistance(elbow_scene(tmp_path))
    found = [trained(distance, hidden=(8, 8), configurations=500, steps=20, held_out=100, seed=s) for s in (3, 3, 4)]
    first, again, other = (result.network.weights[1] for result in found)
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.01
