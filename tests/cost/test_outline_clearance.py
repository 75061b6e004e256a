# SPDX-License-Identifier: Apache-2.0
"""Nearness of outlines seen from above, against the convex hull of their Minkowski difference in float64."""

import numpy as np
import pytest
from outlines import outline_clearance
from rollouts import TURN, Rollouts
from scipy.spatial.transform import Rotation


def put(r: Rollouts, frame: str, places: np.ndarray) -> None:
    """Put a frame's body upright at places (x, y, yaw), one for every step and world."""
    body_q = r.trajectory.body_q.numpy()
    turns = Rotation.from_euler("z", places[:, 2:]).as_quat()
    poses = np.column_stack([places[:, :2], np.full(len(places), 0.1), turns])
    body_q[1:, :, int(r.layout.frame_body[r.layout.frame(frame)])] = poses.reshape(r.t, r.w, 7)
    r.trajectory.body_q.assign(body_q)


def solid(name: str, shape: str, size: tuple, at: tuple, yaw: float = 0.0) -> dict:
    rotation = (0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2))
    return {"name": name, "shape": shape, "size": size, "position": (*at, 0.2), "rotation": rotation}


SLAB = solid("slab", "box", (0.8, 1.0, 0.4), (0.0, 0.0))
SLANT = solid("slant", "box", (0.8, 0.8, 0.4), (0.0, 0.0), np.pi / 4)
CAN = solid("can", "cylinder", (0.2, 0.4), (0.0, 0.0))


@pytest.mark.parametrize(
    ("of", "obstacles", "place", "gaps"),
    [
        ("box", [SLAB], (0.55, 0.0, 0.0), [0.0]),
        ("box", [SLAB], (0.65, 0.1, 0.0), [0.1]),
        ("box", [SLAB], (0.6, 0.85, 0.0), [np.hypot(0.05, 0.1)]),
        ("box", [SLAB], (0.52, 0.73, 0.0), [-0.02]),  # a corner 3 cm and 2 cm within
        ("box", [SLAB], (0.75, 0.0, np.pi / 4), [0.35 - 0.4 * np.sqrt(0.5)]),
        ("box", [SLAB], (0.0, 0.7, np.pi / 2), [0.05]),
        ("box", [SLANT], (0.4 * np.sqrt(2.0) + 0.25, 0.0, 0.0), [0.1]),  # its corner to the middle of a side
        ("box", [SLANT], (0.4 * np.sqrt(2.0) + 0.11, 0.0, 0.0), [-0.04]),
        ("box", [SLAB], (0.95, 0.0, 0.0), [0.4]),
        ("box", [SLAB], (3.0, 2.0, 0.3), [9.0]),
        ("box", [CAN], (0.4, 0.1, 0.0), [0.05]),
        ("box", [CAN], (0.0, -0.44, 0.0), [-0.01]),
        ("base/tip", [SLAB], (0.7, 0.2, 2.0), [0.1]),
        ("base/centre", [SLAB], (0.7, 0.2, -1.0), [0.1]),
        ("base/tip", [CAN], (0.0, -0.55, 1.0), [0.15]),
        ("box", [SLAB, {**CAN, "position": (1.1, 0.0, 0.2)}], (0.65, 0.0, 0.0), [0.1, 0.1]),
        ("box", [SLAB, {**CAN, "position": (1.5, 0.0, 0.2)}], (0.55, 0.0, 0.0), [0.0, 0.6]),
        ("box", [], (0.0, 0.0, 0.0), []),
    ],
)
def test_nearness_of_outlines_grows_evenly_from_where_it_begins(of, obstacles, place, gaps):
    rollouts = Rollouts({"term": "outline_clearance", "of": of, "within": 0.4}, obstacles=obstacles)
    put(rollouts, of, np.tile(place, (rollouts.t * rollouts.w, 1)))
    expected = sum(max(0.0, 1.0 - d / 0.4) for d in gaps)
    # round outlines have 32 corners, up to 1 mm within the circle
    round_ones = of != "box" or CAN["size"] in [o["size"] for o in obstacles]
    np.testing.assert_allclose(rollouts.cost(), expected, atol=6e-3 if round_ones else 2e-5)


@pytest.mark.parametrize("seed", range(2))
def test_nearness_of_boxes_matches_float64_wherever_they_are(seed):
    obstacles = [SLAB, {**SLANT, "position": (1.2, 0.4, 0.3), "rotation": TURN}]
    rollouts = Rollouts({"term": "outline_clearance", "of": "box", "within": 0.4}, obstacles=obstacles)
    rng = np.random.default_rng(seed)
    put(rollouts, "box", rng.uniform([-1.0, -1.0, -3.0], [2.2, 1.4, 3.0], size=(rollouts.t * rollouts.w, 3)))
    own = np.array([(-0.15, -0.25), (0.15, -0.25), (0.15, 0.25), (-0.15, 0.25)])
    expected = outline_clearance(rollouts, "box", own, 0.4)
    assert (expected > 1.0).any()
    assert (expected == 0.0).any()
    np.testing.assert_allclose(rollouts.cost(), expected, atol=2e-5)


@pytest.mark.parametrize(("of", "leaves_out"), [("box", True), ("base/tip", False)])
def test_what_an_object_lies_on_is_not_in_its_way_but_in_a_robots(of, leaves_out):
    far = {**CAN, "position": (1.5, 0.0, 0.2)}
    found = []
    for obstacles in ([far], [far, {**SLAB, "support": True}], [far, SLAB]):
        rollouts = Rollouts({"term": "outline_clearance", "of": of, "within": 0.4}, obstacles=obstacles)
        put(rollouts, of, np.tile((0.9, 0.0, 0.0), (rollouts.t * rollouts.w, 1)))
        found.append(rollouts.cost())
    assert (found[2] > found[0] + 0.1).all()
    np.testing.assert_array_equal(found[1], found[0 if leaves_out else 2])
