# SPDX-License-Identifier: Apache-2.0
"""The way an object can be pushed to its goal, with the pusher's own way around the object, by dynamic programming."""

from __future__ import annotations

from collections.abc import Iterator
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
OBSTRUCTED = 4.0
"""How much dearer the way around the object is where the pusher has no room."""


@dataclass(frozen=True)
class PushRequest:
    """Pusher and object: sizes for the search.

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
        Metres of pushing, the pusher's way included, ``[16, rows, columns]``, in the goal's frame; in cells that the
        object cannot be in, that of the nearest free cell and twice the way there. And the place (x, y) of the first
        cell in that frame [m].
    """
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import dijkstra

    grid, (column, row) = grid.turned(goal, yaw)
    rows, columns = grid.clearance.shape
    count = rows * columns
    edges = [*_edges(grid, request)]
    # one more state for the goal, which is reached from every side; a sparse matrix has no zeros
    edges.append((np.arange(len(STEPS)) * count + row * columns + column, len(STEPS) * count, 1e-6))
    tail, head, cost = (np.concatenate(part) for part in zip(*(np.broadcast_arrays(*e) for e in edges), strict=True))
    graph = csr_matrix((cost, (head, tail)), shape=(len(STEPS) * count + 1,) * 2)  # backwards
    value = dijkstra(graph, indices=len(STEPS) * count)[:-1].reshape(-1, count)
    straight = np.linalg.norm(grid.points - np.asarray(goal), axis=-1).ravel()
    value = np.where(np.isfinite(value), value, 3.0 * straight)  # where no push leads to the goal
    nearest, depth = (a.ravel() for a in grid.nearest_free(request.inflation))
    return (value[:, nearest] + 2.0 * depth).reshape(-1, rows, columns), grid.origin


def _edges(grid: Grid, request: PushRequest) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray | float]]:
    """Tails, heads and costs of all pushes, and of all ways from one side of the object to the next."""
    rows, columns = grid.clearance.shape
    free = grid.clearance >= request.inflation
    room, reach = _room(grid, request)
    sides = len(STEPS)
    index = np.arange(sides * rows * columns).reshape(sides, rows, columns)
    for d in range(sides):
        pushes = [(d, 1.0)]
        if request.faces:  # from the middle of a side, and a little aslant at a price
            pushes = [(d, 1.0), (d - 1, request.slant), (d + 1, request.slant)] if d % 4 == 0 else []
        for way, dearer in pushes:
            step = -STEPS[way % sides]  # away from the pusher
            here, there = _shifted(rows, step[1]), _shifted(columns, step[0])
            source, target = (here[0], there[0]), (here[1], there[1])
            allowed = free[source] & free[target] & room[d][source] & room[d][target]
            yield index[d][source][allowed], index[d][target][allowed], dearer * grid.cell * np.linalg.norm(step)
        e = (d + 1) % sides
        arc = request.turn * ((ANGLES[e] - ANGLES[d]) % (2.0 * np.pi)) * 0.5 * (reach[d] + reach[e])
        walk = np.where(room[d] & room[e], arc, OBSTRUCTED * arc).ravel()
        yield index[d].ravel(), index[e].ravel(), walk
        yield index[e].ravel(), index[d].ravel(), walk


def _shifted(size: int, step: int) -> tuple[slice, slice]:
    """Slices of an axis at the tail and at the head of a step."""
    if step >= 0:
        return slice(0, size - step), slice(step, size)
    return slice(-step, size), slice(0, size + step)


def _room(grid: Grid, request: PushRequest) -> tuple[np.ndarray, np.ndarray]:
    """Return whether the pusher has room in each direction from each cell, and the distance of its centre."""
    along = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)
    half = np.array(request.half_size)
    edge = np.full(len(ANGLES), half[0])
    if request.faces:
        edge = np.min(half / np.maximum(np.abs(along), 1e-9), axis=1)
    rows, columns = grid.clearance.shape
    room = np.ones((len(ANGLES), rows, columns), dtype=bool)
    behind = np.linspace(0.5 * request.width, max(request.length - 0.5 * request.width, 0.5 * request.width), 4)
    for d, back in ((d, b) for d in range(len(ANGLES)) for b in behind):
        off = np.round((edge[d] + back) * along[d] / grid.cell).astype(int)
        column = np.clip(np.arange(columns) + off[0], 0, columns - 1)
        row = np.clip(np.arange(rows) + off[1], 0, rows - 1)
        room[d] &= grid.clearance[np.ix_(row, column)] >= 0.5 * request.width
    return room, edge + 0.5 * request.length
