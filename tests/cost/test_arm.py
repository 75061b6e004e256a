# SPDX-License-Identifier: Apache-2.0
"""An arm's cost terms against float64, on uneven steps and in two environments, and what they mean to a robot."""

import numpy as np
import pytest
from arm_rollouts import ARM, DT, MOBILE, ROBOTS, SHAPE, ArmRollouts
from judging import Judging
from scipy.spatial.transform import Rotation
from small_scenes import chain_scene

from warpmpc import SceneError
from warpmpc.scene.schema import Cost

ARM_JOINTS = tuple(f"panda_joint{i}" for i in range(1, 8))
SPEED = np.array([2.175] * 4 + [2.61] * 3)
"""Velocity limits of the arm's URDF [rad/s]."""


def chain_dofs(r: ArmRollouts) -> list[int]:
    """Degrees of freedom that move the tip: all but the fingers'."""
    return [i for i, name in enumerate(r.layout.dof_name) if "finger" not in name]


def pose(r: ArmRollouts, position=(1.0, 1.0, 1.0), rotation=(1.0, 1.0, 1.0)) -> np.ndarray:
    (p, turn), (goal, goal_turn) = r.pose("arm/tip"), r.pose("goal")
    local = np.einsum("twji,twj->twi", goal_turn, p - goal)
    rows = np.eye(3) - np.einsum("twji,twjk->twik", goal_turn, turn)
    return np.linalg.norm(position * local, axis=-1) + (rotation * np.linalg.norm(rows, axis=-1)).sum(-1)


def stop(r: ArmRollouts, limit) -> np.ndarray:
    left = np.triu(np.ones((r.t, r.t))) @ DT
    beyond = np.abs(r.qd[1:].astype(np.float64)) - left[:, None, None] * np.array(limit)
    return (np.maximum(beyond, 0.0) ** 2).sum(-1)


def measure(r: ArmRollouts, columns: list[int] | None = None) -> np.ndarray:
    """√det(J Jᵀ), or √det(Jᵀ J) where there are fewer than six columns."""
    columns = chain_dofs(r) if columns is None else columns
    return np.prod(np.linalg.svd(r.jacobian()[..., columns], compute_uv=False), axis=-1)


def derivatives(r: ArmRollouts, *, driven: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Accelerations and jerks [T, W, nv] of the joints."""
    step = DT[:, None, None]
    if driven:
        a = r.control.numpy().astype(np.float64)
        before = np.repeat(r.state.last_control.numpy(), r.shape.rollouts, axis=0)[None]
        first = (a[:1] - before) / DT[0]
    else:
        a = np.diff(r.qd.astype(np.float64), axis=0) / step
        first = np.zeros_like(a[:1])
    return a, np.concatenate([first, np.diff(a, axis=0) / (0.5 * (step[1:] + step[:-1]))])


def outside(value: np.ndarray, bound) -> np.ndarray:
    return (np.maximum(np.abs(value) - bound, 0.0) ** 2).sum(-1)


def bounds(r: ArmRollouts, velocity, acceleration=np.inf, jerk=np.inf, margin=0.05, driven=False) -> np.ndarray:
    lower, upper = r.layout.dof_lower.astype(np.float64), r.layout.dof_upper.astype(np.float64)
    reach = np.where(upper - lower < 1e6, 0.5 * (upper - lower), np.inf)
    middle = np.where(np.isfinite(reach), 0.5 * (lower + upper), 0.0)
    a, j = derivatives(r, driven=driven)
    left = 1.0 - margin
    total = outside(r.q[1:] - middle, left * reach) + outside(r.qd[1:].astype(np.float64), left * np.array(velocity))
    return total + outside(a, left * np.array(acceleration)) + outside(j, left * np.array(jerk))


def null_posture(r: ArmRollouts, columns: list[int], target: np.ndarray, damping: float = 0.01) -> np.ndarray:
    j = r.jacobian()[..., columns]
    d = r.q[1:][..., r.layout.dof_coord[columns]] - target.astype(np.float64)
    turned = j.swapaxes(-1, -2)
    back = turned @ np.linalg.inv(j @ turned + damping**2 * np.eye(6))
    return (((np.eye(len(columns)) - back @ j) @ d[..., None])[..., 0] ** 2).sum(-1)


def path_deviation(r: ArmRollouts, start: str | None = None) -> np.ndarray:
    at, to = r.pose("arm/tip")[0], r.pose("goal")[0]
    a = r.pose("arm/tip", first=True)[0] if start is None else r.pose(start)[0]
    share = np.clip(((at - a) * (to - a)).sum(-1) / ((to - a) ** 2).sum(-1), 0.0, 1.0)
    return np.linalg.norm(at - a - share[..., None] * (to - a), axis=-1)


def speed(r: ArmRollouts, linear: float, angular: float) -> np.ndarray:
    twist = np.einsum("twij,twj->twi", r.jacobian(), r.qd[1:].astype(np.float64))
    return outside(np.linalg.norm(twist[..., :3], axis=-1)[..., None], linear) + outside(
        np.linalg.norm(twist[..., 3:], axis=-1)[..., None], angular
    )


def smoothness(r: ArmRollouts, acceleration: float, jerk: float, driven: bool = False) -> np.ndarray:
    a, j = derivatives(r, driven=driven)
    return acceleration * (a**2).sum(-1) + jerk * (j**2).sum(-1)


CASES = {
    "pose": ("arm", {"of": "arm/tip"}, pose),
    "weighted pose": (
        "mobile",
        {"term": "pose", "of": "arm/tip", "position": [100.0, 10.0, 0.0], "rotation": [15.0, 0.0, 3.0]},
        lambda r: pose(r, (100.0, 10.0, 0.0), (15.0, 0.0, 3.0)),
    ),
    "orientation alone": (
        "arm",
        {"term": "pose", "of": "arm/tip", "position": 0.0, "rotation": 2.0},
        lambda r: pose(r, (0.0, 0.0, 0.0), (2.0, 2.0, 2.0)),
    ),
    "stop": ("arm", {"acceleration": 5.0}, lambda r: stop(r, 5.0)),
    "stop of some": (
        "mobile",
        {"term": "stop", "joints": ["x", "yaw"], "acceleration": [1.0, 2.0]},
        lambda r: stop(r, np.array([1.0, np.inf, 2.0] + 9 * [np.inf])),
    ),
    "manipulability": (
        "arm",
        {"of": "arm/tip", "least": 0.1},
        lambda r: np.maximum((0.1 - measure(r)) / 0.1, 0.0),
    ),
    "manipulability of an arm on a base": (
        "mobile",
        {"term": "manipulability", "of": "arm/tip", "least": 2.0},
        lambda r: np.maximum((2.0 - measure(r)) / 2.0, 0.0),
    ),
    "manipulability of the arm alone": (
        "mobile",
        {"term": "manipulability", "of": "arm/tip", "joints": ARM_JOINTS, "least": 0.1, "form": "step"},
        lambda r: np.where(measure(r, list(range(3, 10))) < 0.1, 1.0 - measure(r, list(range(3, 10))), 0.0),
    ),
    "manipulability of three joints": (
        "arm",
        {"term": "manipulability", "of": "arm/tip", "joints": ["arm/panda_joint1", *ARM_JOINTS[1:3]], "least": 1.5},
        lambda r: np.maximum((1.5 - measure(r, [0, 1, 2])) / 1.5, 0.0),
    ),
    "joint_bounds": ("arm", {}, lambda r: bounds(r, SPEED)),
    "joint_bounds of all kinds": (
        "mobile",
        {"term": "joint_bounds", "margin": 0.1, "velocity": 1.0, "acceleration": 10.0, "jerk": 300.0},
        lambda r: bounds(r, 1.0, 10.0, 300.0, 0.1),
    ),
    "null_posture": (
        "arm",
        {"of": "arm/tip"},
        lambda r: null_posture(r, list(range(7)), np.array(ARM["joint_q"])),
    ),
    "null_posture on a base": (
        "mobile",
        {"term": "null_posture", "of": "arm/tip", "joints": [*ARM_JOINTS, "x"], "target": [0.1] * 8, "damping": 0.1},
        lambda r: null_posture(r, [*range(3, 10), 0], np.full(8, 0.1), 0.1),
    ),
    "path_deviation": ("arm", {"of": "arm/tip"}, path_deviation),
    "path_deviation between poses": (
        "mobile",
        {"term": "path_deviation", "of": "arm/tip", "start": "gate"},
        lambda r: path_deviation(r, "gate"),
    ),
    "speed": ("arm", {"of": "arm/tip", "linear": 0.3, "angular": 1.0}, lambda r: speed(r, 0.3, 1.0)),
    "speed of turning": (
        "mobile",
        {"term": "speed", "of": "arm/tip", "angular": 0.5},
        lambda r: speed(r, np.inf, 0.5),
    ),
    "smoothness": ("arm", {}, lambda r: smoothness(r, 1.0, 0.0)),
    "smoothness of jerks": (
        "mobile",
        {"term": "smoothness", "acceleration": 0.5, "jerk": 0.01},
        lambda r: smoothness(r, 0.5, 0.01),
    ),
}


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
        Judging(scene.model_copy(update={"cost": (cost,)}), SHAPE)


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
