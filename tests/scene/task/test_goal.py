# SPDX-License-Identifier: Apache-2.0
"""Where the goal is, and how far a pose is from it."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_scenes import BOX, make_scene

from warpmpc.scene.schema import Goal, Success
from warpmpc.scene.task.goal import goal_error, goal_pose, heading


@pytest.mark.parametrize(
    ("goal", "pose"),
    [
        ({"object": "box", "position": (1.0, 2.0)}, (1.0, 2.0, 0.1, 0.0, 0.0, 0.0, 1.0)),
        ({"object": "box", "position": (1.0, 2.0, 0.7), "yaw": math.pi / 2}, (1.0, 2.0, 0.7, 0, 0, 0.5**0.5, 0.5**0.5)),
        ({"frame": "base/centre", "position": (1.0, 2.0)}, (1.0, 2.0, 0.0, 0.0, 0.0, 0.0, 1.0)),
        ({"frame": "base/centre", "position": (1, 2, 3), "rotation": (2.0, 0.0, 0.0, 0.0)}, (1, 2, 3, 1.0, 0, 0, 0)),
    ],
)
def test_a_goal_is_a_pose(goal, pose):
    np.testing.assert_allclose(goal_pose(make_scene(object=[BOX], goal=goal)), pose, atol=1e-7)


@pytest.mark.parametrize("seed", range(3))
def test_errors_match_scipy(seed):
    rng = np.random.default_rng(seed)
    goal = Goal(object="box", position=(0.0, 0.0, 0.0), yaw=0.0)
    for _ in range(20):
        a, b = Rotation.random(2, rng=rng)
        p, q = rng.normal(size=(2, 3))
        sign = rng.choice([-1.0, 1.0])
        error = goal_error(goal, np.array([*q, *b.as_quat()]), np.array([*p, *(sign * a.as_quat())]))
        np.testing.assert_allclose(error.axes, p - q, atol=1e-6)
        assert error.position == pytest.approx(np.linalg.norm(p - q))
        assert error.rotation == pytest.approx((a.inv() * b).magnitude(), abs=1e-5)
        ax, bx = (np.arctan2(*r.apply([1.0, 0.0, 0.0])[1::-1]) for r in (a, b))
        assert heading(a.as_quat()) == pytest.approx(ax, abs=1e-6)
        assert error.yaw == pytest.approx(abs(np.angle(np.exp(1j * (ax - bx)))), abs=1e-6)


def test_headings_on_both_sides_of_the_cut_are_near():
    def turned(yaw: float) -> np.ndarray:
        return np.array([0, 0, 0, 0, 0, math.sin(yaw / 2), math.cos(yaw / 2)])

    error = goal_error(Goal(object="box", yaw=math.pi), turned(math.pi - 0.01), turned(-math.pi + 0.02))
    assert error.yaw == pytest.approx(0.03)
    assert error.rotation == pytest.approx(0.03, abs=1e-4)


def test_only_the_axes_the_goal_names_count():
    pose, at = np.array([0.1, -0.2, 5.0, 0, 0, 0, 1.0]), np.array([0.0, 0, 0, 0, 0, 0, 1.0])
    assert goal_error(Goal(object="box", position=(0.0, 0.0)), at, pose).position == pytest.approx(np.hypot(0.1, 0.2))
    assert goal_error(Goal(object="box", position=(0.0, 0.0, 0.0)), at, pose).position > 5.0


@pytest.mark.parametrize(
    ("tolerance", "within"),
    [
        ({"position": 0.2}, True),
        ({"position": 0.19}, False),  # per axis, of either sign
        ({"position": (0.1, 0.2)}, True),
        ({"position": (0.2, 0.1)}, False),
        ({"distance": 0.23}, True),
        ({"distance": 0.22}, False),
        ({"position": 0.2, "yaw": 0.5}, True),
        ({"position": 0.2, "yaw": 0.3}, False),
        ({"rotation": 0.41}, True),
        ({"position": 1.0, "rotation": 0.39}, False),
    ],
)
def test_success_needs_every_tolerance(tolerance, within):
    turn = [0, 0, math.sin(-0.2), math.cos(-0.2)]  # yaw -0.4
    error = goal_error(
        Goal(object="box", position=(0.0, 0.0), yaw=0.0),
        np.array([0.0, 0, 0, 0, 0, 0, 1]),
        np.array([0.1, -0.2, 9, *turn]),
    )
    assert error.within(Success(**tolerance)) is within


def test_the_worst_axis_is_the_one_farthest_from_its_tolerance():
    at = np.array([0.0, 0, 0, 0, 0, 0, 1])
    error = goal_error(Goal(object="box", position=(0.0, 0.0)), at, np.array([0.1, -0.2, 9, 0, 0, 0, 1]))
    assert error.worst_axis(Success(position=0.05)) == pytest.approx(0.2)
    assert error.worst_axis(Success(position=(0.05, 0.5))) == pytest.approx(0.1)
    assert error.worst_axis(Success(distance=0.05)) is None


def test_a_pose_that_is_not_finite_is_never_within():
    pose = np.full(7, np.nan)
    at = np.array([0.0, 0, 0, 0, 0, 0, 1])
    error = goal_error(Goal(object="box", position=(0.0, 0.0), yaw=0.0), at, pose)
    for tolerance in ({"position": 1e9}, {"distance": 1e9}, {"yaw": 10.0}):
        assert not error.within(Success(**tolerance))


def test_every_axis_is_compared_with_its_own_tolerance():
    pose, at = np.array([0.1, -0.2, 5.0, 0, 0, 0, 1.0]), np.array([0.0, 0, 0, 0, 0, 0, 1.0])
    error = goal_error(Goal(object="box", position=(0.0, 0.0)), at, pose)
    rows = [(row.name, row.value, row.bound) for row in error.compared(Success(position=(0.05, 0.5)))]
    assert rows == [("error along x [m]", 0.1, 0.05), ("error along y [m]", 0.2, 0.5)]
