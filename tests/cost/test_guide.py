# SPDX-License-Identifier: Apache-2.0
"""Fields put together on the device against fast marching from the target itself."""

import numpy as np
import pytest
import warp as wp
from small_scenes import BOX, compiled, make_scene

from warpmpc.cost.binding import FieldRequest
from warpmpc.cost.geodesic import Grid
from warpmpc.cost.guide import Guide

WALLS = (
    {"name": "left", "shape": "box", "size": (0.6, 0.8, 0.2), "position": (1.0, 1.0, 0.1)},
    {"name": "right", "shape": "box", "size": (0.6, 0.8, 0.2), "position": (-0.4, 0.8, 0.1)},
)
INFLATIONS = (0.2, 0.4)


class Follower:
    """Two fields per environment: to the box for a small mover, to the goal for a large one."""

    def __init__(self, *, envs: int = 1, obstacles=WALLS, device: str = "cpu"):
        layout = compiled(make_scene(object=[BOX], obstacle=obstacles)).layout
        self.grid = Grid(layout, np.array([[-2.0, -1.5], [2.5, 2.5]]))
        requests = [FieldRequest(layout.frame("box"), INFLATIONS[0]), FieldRequest(layout.frame("goal"), INFLATIONS[1])]
        self.guide = Guide(self.grid, requests, layout, envs=envs, device=device)
        self.layout, self.envs, self.device = layout, envs, device

    def __call__(self, boxes, goals=((0.0, -1.0),)) -> np.ndarray:
        """Bring the fields to boxes and goals [E, 2]; returns them ``[E, 2, rows, columns]``."""
        body_q = np.zeros((2, 3 * self.envs, self.layout.nb, 7), np.float32)
        body_q[..., 6] = 1.0
        goal = np.zeros((self.envs, 7), np.float32)
        goal[:, 6] = 1.0
        body_q[0, ::3, self.layout.entity("box").bodies[0], :2] = boxes
        goal[:, :2] = goals
        self.guide.set_goal(goal)
        self.guide.launch(wp.array(body_q, dtype=wp.transform, device=self.device), 3)
        rows, columns = self.grid.clearance.shape
        return self.guide.field.numpy().reshape(self.envs, 2, rows, columns)


@pytest.mark.parametrize("target", [(2.0, 2.0), (1.6, 0.0), (-1.5, 0.9), (0.3, -0.8)])
def test_it_agrees_with_fast_marching_from_the_target(target, device):
    follower = Follower(device=device)
    fields = follower([target], [target])[0]
    for field, inflation in zip(fields, INFLATIONS, strict=True):
        exact = follower.grid.path_length(np.array(target), inflation)
        free = follower.grid.clearance > inflation
        straight = np.linalg.norm(follower.grid.points - target, axis=-1)
        assert (exact - straight)[free].max() > 0.3  # there is something to go around
        np.testing.assert_allclose(field[free], exact[free], atol=1.3 * follower.grid.cell)
        assert np.abs(field - exact)[free].mean() < 0.2 * follower.grid.cell
        assert (field >= straight - 1e-5)[free].all()


def test_without_obstacles_every_way_is_straight():
    follower = Follower(obstacles=())
    field = follower([(0.7, 0.4)])[0, 0]
    np.testing.assert_allclose(field, np.linalg.norm(follower.grid.points - (0.7, 0.4), axis=-1), atol=1e-5)


def test_a_field_leads_out_of_a_grown_obstacle():
    follower = Follower()
    field = follower([(2.0, 2.0)])[0, 0]
    inside = np.argwhere(follower.grid.clearance < INFLATIONS[0])
    lowest = [field[max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2].min() < field[r, c] for r, c in inside]
    assert np.mean(lowest) == 1.0


def test_every_environment_follows_its_own_targets():
    follower, alone = Follower(envs=3), Follower()
    boxes, goals = [(2.0, 2.0), (1.6, 0.0), (-1.5, 0.9)], [(0.0, -1.0), (0.5, -1.0), (1.0, -1.0)]
    fields = follower(boxes, goals)
    for e in range(3):
        np.testing.assert_array_equal(fields[e], alone([boxes[e]], [goals[e]])[0])


def test_a_field_waits_until_its_target_has_moved_by_half_a_cell():
    follower = Follower()
    first = follower([(1.6, 0.0)]).copy()
    np.testing.assert_array_equal(follower([(1.6, 0.02)]), first)
    moved = follower([(1.6, 0.1)])
    assert not np.array_equal(moved[0, 0], first[0, 0])
    np.testing.assert_array_equal(moved[0, 1], first[0, 1])  # the goal stayed
    follower.guide.reset()
    np.testing.assert_array_equal(follower([(1.6, 0.1)]), moved)


def test_a_target_beyond_the_grid_is_moved_onto_it():
    follower = Follower()
    field = follower([(100.0, 0.0)])[0, 0]
    np.testing.assert_array_equal(follower.guide.center.numpy()[0], [follower.grid.points[0, -1, 0], 0.0])
    assert np.isfinite(field).all()
