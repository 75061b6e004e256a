# SPDX-License-Identifier: Apache-2.0
"""The way an object can be pushed to its goal, with the pusher's own way around the object, by dynamic programming."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from .geodesic import Grid

STEPS = np.array([(1, 0), (2, 1), (1, 1), (1, 2), (0, 1), (-1, 2), (-1, 1), (-2, 1)])
STEPS = np.concatenate([STEPS, -STEPS])
"""Columns and rows from one cell to the next in each of the 16 directions, counter-clockwise."""
ANGLES = np.arctan2(STEPS[:, 1], STEPS[:, 0]) % (2.0 * np.pi)
"""Those directions [rad], ascending."""
_FINEST = 0.5 * np.arctan(0.5) + 1e-6
"""No direction is farther than this from one of the 16 [rad]."""
OBSTRUCTED = 4.0
"""How much dearer the way around the object is where the pusher has no room."""


@dataclass(frozen=True)
class PushRequest:
    """Who pushes what: sizes for the search.

    Args:
        inflation: Obstacles grow by this for the object [m].
        half_size: Half extents (x, y) of the object's outline [m], or its radius twice with ``faces`` False.
        faces: Whether the object has four sides to push at; else every direction is as good.
        width: Width of the pusher across its direction of pushing [m].
        length: Length of the pusher behind its contact [m].
        turn: Cost of a metre of the pusher's way around the object, relative to a metre of pushing.
        slant: How much dearer a push is at about 27° to a side's normal than square to it.
    """

    inflation: float
    half_size: tuple[float, float]
    faces: bool
    width: float
    length: float
    turn: float
    slant: float


def push_value(grid: Grid, request: PushRequest, goal: np.ndarray, yaw: float) -> tuple[np.ndarray, np.ndarray]:
    """Least work from every place of the object and every side of the pusher.

    States are (cell of the object, direction from the object to the pusher). A push moves the object away from the
    pusher by one step, where the pusher has room behind it; the pusher may also walk around the object. Shortest paths
    to the goal by Dijkstra's algorithm (SciPy). The object is thought to keep the goal's heading.

    Args:
        grid: Grid over the scene.
        request: Sizes.
        goal: Goal (x, y) [m].
        yaw: Heading of the goal [rad].

    Returns:
        Metres of pushing, the pusher's way included, ``[16, rows, columns]``; in cells that the object cannot be in,
        that of the nearest free cell and twice the way there. And the place of the first cell (x, y) [m]: the cells are
        the grid's, moved so that the goal is in the middle of one.
    """
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import dijkstra

    grid, (column, row) = grid.through(goal)
    rows, columns = grid.clearance.shape
    count, sides = rows * columns, len(STEPS)
    free = grid.clearance >= request.inflation
    room, reach = _room(grid, request, yaw)
    index = np.arange(sides * count).reshape(sides, rows, columns)
    tails, heads, costs = [], [], []
    length = grid.cell * np.linalg.norm(STEPS, axis=1)
    square = _slant(yaw) <= _FINEST if request.faces else np.ones(sides, dtype=bool)
    for d in range(sides):
        # square to a side a push may also go a little aslant, within the friction cone
        for way, dearer in ((d, 1.0), (d - 1, request.slant), (d + 1, request.slant)) if square[d] else ():
            di, dj = -STEPS[way % sides]  # away from the pusher
            here, there = _shifted(rows, dj), _shifted(columns, di)
            source, target = (here[0], there[0]), (here[1], there[1])
            allowed = free[source] & free[target] & room[d][source] & room[d][target]
            tails.append(index[d][source][allowed])
            heads.append(index[d][target][allowed])
            costs.append(np.full(allowed.sum(), dearer * length[way % sides]))
        e = (d + 1) % sides
        angle = (ANGLES[e] - ANGLES[d]) % (2.0 * np.pi)
        arc = request.turn * angle * 0.5 * (reach[d] + reach[e])
        walk = np.where(room[d] & room[e], arc, OBSTRUCTED * arc).ravel()
        for a, b in ((d, e), (e, d)):
            tails.append(index[a].ravel())
            heads.append(index[b].ravel())
            costs.append(walk)
    tails.append(index[:, row, column])
    heads.append(np.full(sides, sides * count))
    costs.append(np.full(sides, 1e-6))  # a sparse matrix has no zeros
    tail, head, cost = (np.concatenate(parts) for parts in (tails, heads, costs))
    graph = csr_matrix((cost, (head, tail)), shape=(sides * count + 1,) * 2)  # backwards
    value = dijkstra(graph, indices=sides * count)[:-1].reshape(sides, rows, columns)
    straight = np.linalg.norm(grid.points - np.asarray(goal), axis=-1)
    value = np.where(np.isfinite(value), value, 3.0 * straight)
    nearest, depth = grid.nearest_free(request.inflation)
    return (value.reshape(sides, count)[:, nearest.ravel()] + 2.0 * depth.ravel()).reshape(value.shape), grid.origin


def _shifted(size: int, step: int) -> tuple[slice, slice]:
    """Slices of an axis at the tail and at the head of a step."""
    if step >= 0:
        return slice(0, size - step), slice(step, size)
    return slice(-step, size), slice(0, size + step)


def _slant(yaw: float) -> np.ndarray:
    """Angle of every direction to the nearest side's normal, in [0, π/4]."""
    turned = (ANGLES - yaw) % (0.5 * np.pi)
    return np.minimum(turned, 0.5 * np.pi - turned)


def _room(grid: Grid, request: PushRequest, yaw: float) -> tuple[np.ndarray, np.ndarray]:
    """Whether the pusher has room in each direction from each cell, and how far its centre is from the object's."""
    local = np.stack([np.cos(ANGLES - yaw), np.sin(ANGLES - yaw)], axis=1)
    half = np.array(request.half_size)
    edge = np.full(len(ANGLES), half[0])
    if request.faces:
        edge = np.min(half / np.maximum(np.abs(local), 1e-9), axis=1)
    rows, columns = grid.clearance.shape
    room = np.ones((len(ANGLES), rows, columns), dtype=bool)
    direction = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)
    behind = np.linspace(0.5 * request.width, max(request.length - 0.5 * request.width, 0.5 * request.width), 4)
    for d, back in ((d, b) for d in range(len(ANGLES)) for b in behind):
        at = (grid.points + (edge[d] + back) * direction[d] - grid.origin) / grid.cell
        column = np.clip(np.round(at[..., 0]).astype(int), 0, columns - 1)
        row = np.clip(np.round(at[..., 1]).astype(int), 0, rows - 1)
        room[d] &= grid.clearance[row, column] >= 0.5 * request.width
    return room, edge + 0.5 * request.length
