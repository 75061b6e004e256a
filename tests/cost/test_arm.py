# SPDX-License-Identifier: Apache-2.0
"""An arm's cost terms against float64, on uneven steps and in two environments, and what they mean to a robot."""

import numpy as np
import pytest
from arm_references import CASES, SPEED, bounds, smoothness, stop
from arm_rollouts import ARM, DT, MOBILE, ROBOTS, SHAPE, ArmRollouts
from evaluating import Evaluating
from scipy.spatial.transform import Rotation
from small_scenes import chain_scene

from warpmpc import SceneError
from warpmpc.scene.schema import Cost


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", CASES)
def test_terms_match_float64(name, seed, device):
    robot, keys, reference = CASES[name]
    rollouts = ArmRollouts(ROBOTS[robot], {"term": name, "weight": 2.5, **keys}, seed=seed, device=device)
    expected = 2.5 * reference(rollouts)
    assert np.ptp(expected) > 0.1
    np.testing.assert_allclose(rollouts.value(), expected, rtol=5e-4, atol=5e-4)


@pytest.mark.parametrize("seed", range(2))
def test_drives_of_accelerations_say_what_joints_do(seed):
    costs = [
        {"term": "stop"},
        {"term": "smoothness", "jerk": 0.02},
        {"term": "joint_bounds", "acceleration": 1.0, "jerk": 30.0},
    ]
    r = ArmRollouts(ARM, *costs, seed=seed, accelerations=True)
    limit = np.array(ARM["drive"]["limit"])
    wanted = [stop(r, limit), smoothness(r, 1.0, 0.02, True), bounds(r, SPEED, 1.0, 30.0, driven=True)]
    for found, expected in zip(r.cost(), wanted, strict=True):
        np.testing.assert_allclose(found, expected, rtol=5e-4, atol=5e-4)


def test_the_null_space_is_what_leaves_the_tip_where_it_is():
    cost = {"term": "null_posture", "of": "arm/tip", "damping": 1e-3}
    r = ArmRollouts(ARM, cost, {"term": "posture"}, seed=1)
    start = np.array(ARM["joint_q"])
    r.q[1:] = start
    j = r.jacobian()
    rows = j.swapaxes(-1, -2) @ np.random.default_rng(0).normal(size=(r.t, r.w, 6, 1))
    asked, free = rows[..., 0] / np.linalg.norm(rows, axis=-2), np.linalg.svd(j)[2][..., -1, :]
    # a small way off that the tip's pose asks for costs next to nothing, along the null space as much as in `posture`
    for step, share in ((asked, 0.0), (free, 1.0)):
        r.q[1:] = start + 0.02 * step
        r.move()
        found, posture = r.cost()
        np.testing.assert_allclose(posture, 0.02**2, rtol=1e-3)
        np.testing.assert_allclose(found, share * 0.02**2, atol=0.02 * 0.02**2)


def test_an_orientation_is_held_anywhere():
    r = ArmRollouts(ARM, {"term": "pose", "of": "arm/tip", "position": 0.0}, {"term": "orientation", "of": "arm/tip"})
    turn = r.pose("arm/tip")[1]
    held = turn[0, :: r.shape.rollouts]
    r.set_goal(np.concatenate([r.goal[:, :3] + 5.0, Rotation.from_matrix(held).as_quat()], axis=1))
    found = r.cost()[:, 0, :: r.shape.rollouts]
    np.testing.assert_allclose(found, 0.0, atol=1e-3)


def test_a_joint_that_brakes_as_hard_as_it_can_pays_nothing_and_a_faster_one_does():
    r = ArmRollouts(ARM, {"term": "stop", "acceleration": 2.0})
    left = np.cumsum(DT[::-1])[::-1]
    qd = np.zeros_like(r.qd)
    qd[1:, :, 2] = -2.0 * left[:, None]
    r.trajectory.joint_qd.assign(qd)
    np.testing.assert_allclose(r.value(), 0.0, atol=1e-10)
    r.trajectory.joint_qd.assign(1.1 * qd)
    np.testing.assert_allclose(r.value(), np.broadcast_to((0.2 * left[:, None]) ** 2, (r.t, r.w)), rtol=1e-3)


@pytest.mark.parametrize("term", ["pose", "path_deviation"])
def test_a_goal_without_a_height_is_compared_in_the_plane(term):
    r = ArmRollouts(ARM, {"term": term, "of": "arm/tip"}, flat=True)
    before = r.value()
    assert before.min() > 0.0
    goal = r.goal.copy()
    goal[:, 2] += 3.0
    r.set_goal(goal)
    np.testing.assert_array_equal(r.value(), before)


def test_a_ball_joint_has_no_axes_for_a_jacobian(tmp_path):
    scene = chain_scene(tmp_path)
    cost = Cost.model_validate({"term": "manipulability", "of": "chain/head"})
    with pytest.raises(SceneError, match=r"cost\.manipulability\.of: a ball joint moves this frame.*neck"):
        Evaluating(scene.model_copy(update={"cost": (cost,)}), SHAPE)


@pytest.mark.parametrize(
    ("robot", "cost", "message"),
    [
        (ARM, {"term": "pose", "of": "arm/tpi"}, r"cost\.pose\.of.*Did you mean 'arm/tip'"),
        (ARM, {"term": "pose", "of": "arm/tip", "position": [1.0, 2.0]}, r"cost\.pose\.position: needs 1 or 3 values"),
        (ARM, {"term": "pose", "of": "arm/tip", "rotation": -1.0}, r"cost\.pose\.rotation"),
        (ARM, {"term": "stop"}, r"cost\.stop\.acceleration: no drive of these joints takes accelerations"),
        (ARM, {"term": "stop", "acceleration": [1.0, 2.0]}, r"cost\.stop\.acceleration: needs 1 or 7 values"),
        (ARM, {"term": "stop", "joints": ["panda_jiont1"]}, r"cost\.stop\.joints.*Did you mean"),
        (ARM, {"term": "manipulability", "of": "goal"}, r"cost\.manipulability\.of: no joint moves this frame"),
        (ARM, {"term": "manipulability", "of": "arm/tip", "form": "hill"}, r"cost\.manipulability\.form"),
        (
            MOBILE,
            {"term": "manipulability", "of": "arm/tip", "joints": ["panda_finger_joint1"]},
            r"cost\.manipulability\.joints: this joint does not move the frame.*panda_joint1",
        ),
        (
            ARM,
            {"term": "null_posture", "of": "arm/tip", "joints": ["panda_joint1", "arm/panda_joint1"]},
            r"cost\.null_posture\.joints: a joint is named twice",
        ),
        (
            ARM,
            {"term": "null_posture", "of": "arm/tip", "target": [0.0]},
            r"posture\.target: needs one value per joint, 7",
        ),
        (ARM, {"term": "joint_bounds", "velocity": [1.0] * 3}, r"cost\.joint_bounds\.velocity: needs 1 or 7 values"),
        (ARM, {"term": "joint_bounds", "margin": 1.0}, r"cost\.joint_bounds\.margin"),
        (ARM, {"term": "joint_bounds", "of": "amr"}, r"cost\.joint_bounds\.of.*Did you mean 'arm'"),
        (ARM, {"term": "path_deviation", "of": "arm/tip", "start": "gat"}, r"deviation\.start.*Did you mean 'gate'"),
        (ARM, {"term": "speed", "of": "arm/tip"}, r"cost\.speed: needs linear, angular, or both"),
        (ARM, {"term": "smoothness", "jolt": 1.0}, r"cost\.smoothness\.jolt: unknown key"),
    ],
)
def test_mistakes_name_the_key_and_a_way_out(robot, cost, message):
    with pytest.raises(SceneError, match=message):
        ArmRollouts(robot, cost)
