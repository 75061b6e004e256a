# SPDX-License-Identifier: Apache-2.0
"""Fields put together on the device: against shortest paths over the grid, and as their targets move."""

import numpy as np
import pytest
import warp as wp
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from small_scenes import BOX, compiled, make_scene

from warpmpc.cost.resources.geodesic import Grid
from warpmpc.cost.resources.guide import FieldRequest, Guide

WALLS = (
    {"name": "left", "shape": "box", "size": (0.6, 0.8, 0.2), "position": (1.0, 1.0, 0.1)},
    {"name": "right", "shape": "box", "size": (0.6, 0.8, 0.2), "position": (-0.4, 0.8, 0.1)},
)
INFLATIONS = (0.2, 0.3)


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
        body_q = np.zeros((self.envs, self.layout.nb, 7), np.float32)
        goal = np.zeros((self.envs, 1, 7), np.float32)
        body_q[..., 6] = goal[..., 6] = 1.0
        body_q[:, self.layout.entity("box").bodies[0], :2] = boxes
        goal[:, 0, :2] = goals
        upload = {"dtype": wp.transform, "device": self.device}
        self.guide.launch(wp.array(body_q, **upload), wp.array(goal, **upload))
        rows, columns = self.grid.clearance.shape
        return self.guide.field.numpy().reshape(self.envs, 2, rows, columns)


def over_the_grid(grid: Grid, target, inflation: float) -> np.ndarray:
    """Path lengths from every free cell to a target by Dijkstra's algorithm over 32 neighbours, at most 1.5 % long."""
    rows, columns = grid.clearance.shape
    free = (grid.clearance >= inflation).ravel()
    index = np.arange(rows * columns).reshape(rows, columns)
    moves = [(1, 0), (1, 1), (2, 1), (3, 1), (3, 2), (4, 1), (4, 3)]
    moves = {(sx * a, sy * b) for i, j in moves for a, b in ((i, j), (j, i)) for sx in (1, -1) for sy in (1, -1)}
    heads, tails, lengths = [], [], []
    for dr, dc in moves:
        r, c = np.mgrid[max(0, -dr) : rows - max(0, dr), max(0, -dc) : columns - max(0, dc)]
        a, b = index[r, c].ravel(), index[r + dr, c + dc].ravel()
        # long moves must not jump over a corner
        middle = index[r + int(np.fix(dr / 2)), c + int(np.fix(dc / 2))].ravel()
        open_way = free[a] & free[b] & free[middle]
        heads.append(a[open_way])
        tails.append(b[open_way])
        lengths.append(np.full(open_way.sum(), grid.cell * np.hypot(dr, dc)))
    graph = csr_matrix(
        (np.concatenate(lengths), (np.concatenate(heads), np.concatenate(tails))), shape=2 * (index.size,)
    )
    column, row = np.round((np.asarray(target) - grid.origin) / grid.cell).astype(int)
    return dijkstra(graph, indices=index[row, column]).reshape(rows, columns)


@pytest.mark.parametrize("target", [(2.0, 2.0), (1.9, 0.0), (-1.5, 0.9), (0.3, -0.8)])
def test_it_agrees_with_shortest_paths_over_the_grid(target, device):
    follower = Follower(device=device)
    fields = follower([target], [target])[0]
    for field, inflation in zip(fields, INFLATIONS, strict=True):
        expected = over_the_grid(follower.grid, target, inflation)
        known = np.isfinite(expected)
        straight = np.linalg.norm(follower.grid.points - target, axis=-1)
        assert (expected - straight)[known].max() > 0.3  # there is something to go around
        cell = follower.grid.cell
        assert (field <= 1.01 * expected + 1.5 * cell)[known].all()
        assert (field >= 0.985 * expected - 1.5 * cell)[known].all()
        assert (field >= straight - 1e-5).all()


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


def test_a_field_waits_until_its_target_has_moved_by_a_cell():
    follower = Follower()
    first = follower([(1.6, 0.0)]).copy()
    np.testing.assert_array_equal(follower([(1.6, 0.045)]), first)
    moved = follower([(1.6, 0.055)])
    assert not np.array_equal(moved[0, 0], first[0, 0])
    np.testing.assert_array_equal(moved[0, 1], first[0, 1])  # the goal stayed
    follower.guide.reset()
    np.testing.assert_array_equal(follower([(1.6, 0.055)]), moved)


def test_a_target_beyond_the_grid_is_moved_onto_it():
    follower = Follower()
    field = follower([(100.0, 0.0)])[0, 0]
    np.testing.assert_array_equal(follower.guide.center.numpy()[0], [follower.grid.points[0, -1, 0], 0.0])
    assert np.isfinite(field).all()
