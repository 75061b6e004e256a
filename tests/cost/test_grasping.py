# SPDX-License-Identifier: Apache-2.0
"""What the terms that pick an object up want of the hand, step by step."""

import numpy as np
import pytest
from rollouts import Rollouts
from scipy.spatial.transform import Rotation

KEYS = {"term": "approach", "hand": "base/tip", "object": "box", "width": 0.02, "rise": 0.06}


def cost_at(cost: dict, offset: np.ndarray, *, control: float = 0.5, turn=(0.0, 0.0, 0.0, 1.0)) -> np.ndarray:
    """Cost of an upright hand at offsets ``[N, 3]`` from the object [m], which is turned by ``[N, 4]``."""
    r = Rollouts(cost)
    where = np.resize(offset, (r.t * r.w, 3)).reshape(r.t, r.w, 3)
    layout, body_q = r.layout, r.trajectory.body_q.numpy()
    hand, box = (int(layout.frame_body[layout.frame(name)]) for name in ("base/tip", "box"))
    local = layout.frame_pose[layout.frame("base/tip")][:3]
    body_q[1:, :, hand, 3:] = [0.0, 0.0, 0.0, 1.0]
    body_q[1:, :, box, 3:] = np.resize(turn, (r.t * r.w, 4)).reshape(r.t, r.w, 4)
    body_q[1:, :, box, :3] = [0.3, -0.2, 0.5]
    body_q[1:, :, hand, :3] = [0.3, -0.2, 0.5] + where - local
    r.trajectory.body_q.assign(body_q)
    r.control.fill_(control)
    return r.cost().ravel()[: len(offset)]


@pytest.mark.parametrize("height", [0.0, 0.01, 0.02, 0.04, 0.06, 0.1])
def test_no_place_beside_the_object_is_better_than_the_one_above_it(height):
    beside = np.linspace(0.0, 0.1, 40)
    found = cost_at(KEYS, np.column_stack([beside, 0.0 * beside, np.full(40, height)]))
    assert (np.diff(found) > 0.0).all()


def test_above_the_object_down_is_better_and_beside_it_only_to_its_rise():
    height = np.linspace(0.0, 0.12, 40)
    above = cost_at(KEYS, np.column_stack([0.0 * height, 0.0 * height, height]))
    assert (np.diff(above) > 0.0).all()
    assert above[0] == pytest.approx(0.0, abs=1e-6)
    beside = cost_at(KEYS, np.column_stack([0.0 * height + 0.05, 0.0 * height, height]))
    assert height[beside.argmin()] == pytest.approx(0.06, abs=0.004)


@pytest.mark.parametrize(("control", "opening"), [(1.0, 1.0), (0.5, 0.5), (-1.0, -1.0)])
def test_fingers_lose_nothing_when_they_arrive(control, opening):
    cost = {"term": "gripper", "hand": "base/tip", "object": "box", "near": 0.03, "fingers": ["base/x"]}
    away = np.linspace(0.0, 0.06, 40)
    found = cost_at(cost, np.column_stack([away, 0.0 * away, 0.0 * away]), control=control)
    assert found[away < 0.03] == pytest.approx(0.5 * (1.0 + opening))
    assert found[away > 0.03] == pytest.approx(1.0 + 0.5 * (1.0 - opening))
    assert (np.diff(found) >= 0.0).all()


def test_fingers_meet_the_faces_of_a_box_that_lies_on_its_side():
    cost = {"term": "finger_alignment", "hand": "base/tip", "object": "box"}
    for tip in (0.0, 0.5 * np.pi, np.pi):
        heading = np.linspace(0.0, 0.5 * np.pi, 40)
        turn = Rotation.from_euler("xz", np.column_stack([np.full(40, tip), heading]))
        found = cost_at(cost, np.full((40, 3), 0.1), turn=turn.as_quat())
        np.testing.assert_allclose(found, 0.5 * (1.0 - np.cos(4.0 * heading)), atol=1e-5)
