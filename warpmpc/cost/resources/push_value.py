# SPDX-License-Identifier: Apache-2.0
"""Push values of a stack's terms: searched for anew when the goal moves, beside the planning.

The way an object can be pushed to its goal, with the pusher's own way around the object, by dynamic programming.
"""

from __future__ import annotations

import functools
import logging
import math
import os
import pickle
import queue
import subprocess
import sys
import threading
import weakref
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ...physics.runtime.launch import capturing
from .geodesic import CELL, Ground
from .resource import Resource

if TYPE_CHECKING:
    from ...scene.task.task import Task
    from .geodesic import Grid
    from .resource import Resources

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


@functools.lru_cache(maxsize=8)
def _recent(grid: Grid, request: PushRequest, goal: tuple[float, ...], yaw: float) -> tuple[np.ndarray, np.ndarray]:
    """The same; what judges an episode, and the next episode, search for what its planner searched for."""
    return push_value(grid, request, np.array(goal), yaw)


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


logger = logging.getLogger("warpmpc")

MARGIN = 30
"""Cells around everything in the scene in which ways to push are searched."""
FINE = 0.4
"""Largest cell in half extents of the pushed object: a fifth of its extent."""


class PushValues(Resource):
    """Least work to push objects to the goal, one value per term and environment (:func:`push_value`).

    A search takes tenths of a second. The first is waited for; when the goal moves later, it runs in a process of its
    own (SciPy's search holds Python's lock) and plans go on with the old value until the new one is there.
    """

    def __init__(self, resources: Resources):
        self._ground = resources.get(Ground)
        self._readers: list[tuple[Any, PushRequest]] = []
        self._search = Search()

    def request(self, params: Any, request: PushRequest) -> None:
        """Ask for a push value.

        Args:
            params: Parameters of the term, whose ``value``, ``origin`` and ``cell`` will be filled.
            request: Who pushes what.
        """
        self._readers.append((params, request))
        cell = min(CELL, FINE * min(request.half_size))
        self._ground.need(room=request.inflation + request.length, cell=cell, margin=MARGIN)

    def allocate(self, envs: int, device: str) -> None:
        """Allocate the values and point the terms at them."""
        grid = self._ground.grid
        side = grid.size(grid.clearance.shape)
        for params, _ in self._readers:
            params.value = wp.zeros((envs, side, side, len(STEPS)), dtype=float, device=device)
            params.origin = wp.zeros(envs, dtype=wp.vec2, device=device)
            params.cell = grid.cell
        self._shown = np.full((envs, 7), np.nan, dtype=np.float32)  # goals of the values in use
        self._wanted = self._shown.copy()
        self._searched: dict[int, np.ndarray] = {}  # environment → goal that is being searched for

    def on_task_change(self, task: Task, names: frozenset[str]) -> None:
        """Take note of goals that moved."""
        if "goal" in names:
            self._wanted = np.array([task.pose("goal", e) for e in range(len(self._wanted))])

    def refresh(self) -> None:
        """Take over finished searches and begin those that are wanted."""
        for e, values in self._search.finished():
            goal = self._searched.pop(e)
            if values is None:
                logger.warning("a search for ways to push failed; searching here, which holds up this plan")
                self.settle()
                break
            self._take(e, goal, values)
        if np.isnan(self._shown).any():
            self.settle()
        for e in np.flatnonzero((self._wanted != self._shown).any(axis=1)):
            if int(e) not in self._searched:
                self._searched[int(e)] = self._wanted[e].copy()
                self._search.begin(int(e), self._jobs(self._wanted[e]))

    def settle(self) -> None:
        """Search for every goal that is wanted and wait for it."""
        self._search.stop()
        self._searched.clear()
        known: dict[bytes, list] = {}
        for e in np.flatnonzero((self._wanted != self._shown).any(axis=1)):
            goal = self._wanted[e]
            key = goal.tobytes()
            if key not in known:
                known[key] = [_recent(grid, r, tuple(to), yaw) for grid, r, to, yaw in self._jobs(goal)]
            self._take(int(e), goal, known[key])

    def _jobs(self, goal: np.ndarray) -> list[tuple]:
        x, y, z, w = (float(c) for c in goal[3:])
        heading = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        return [(self._ground.grid, request, goal[:2], heading) for _, request in self._readers]

    def _take(self, e: int, goal: np.ndarray, values: list[tuple[np.ndarray, np.ndarray]]) -> None:
        for (params, _), (value, origin) in zip(self._readers, values, strict=True):
            with capturing:
                params.value[e].assign(np.ascontiguousarray(np.moveaxis(value, 0, -1), dtype=np.float32))
                params.origin[e : e + 1].assign(origin[None].astype(np.float32))
        self._shown[e] = goal


class Search:
    """A process that searches push values, fed and read by a thread, both started when they are first needed."""

    def __init__(self):
        self._jobs: queue.SimpleQueue | None = None
        self._process: subprocess.Popen | None = None
        self._done: list[tuple[int, list | None]] = []
        self._lock = threading.Lock()

    def begin(self, e: int, jobs: list[tuple]) -> None:
        """Begin the search for one environment; returns at once."""
        if self._jobs is None:
            self._jobs = queue.SimpleQueue()
            threading.Thread(target=_feed, args=[self._jobs, weakref.ref(self)], daemon=True).start()
        self._jobs.put((e, jobs))

    def finished(self) -> list[tuple[int, list | None]]:
        """Environment and values of the searches that have ended since the last call; None for one that failed."""
        with self._lock:
            done, self._done = self._done, []
        return done

    def stop(self) -> None:
        """Give up what is being searched for."""
        with self._lock:
            jobs, process = self._jobs, self._process
            self._jobs, self._process, self._done = None, None, []
        if jobs is not None:
            jobs.put(None)
        if process is not None:
            process.kill()
            process.wait()

    def __del__(self):
        self.stop()


def _feed(jobs: queue.SimpleQueue, search: weakref.ref[Search]) -> None:
    """Hand jobs to the process in turn and gather what it finds, until told to stop."""
    command = [sys.executable, "-P", "-m", __name__]  # nothing of the working directory is imported
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)

    def owner() -> Search | None:
        """The search, while it still wants what this thread finds."""
        found = search()
        return found if found is not None and found._jobs is jobs else None

    if (found := owner()) is not None:
        found._process = process
    del found
    while (job := jobs.get()) is not None:
        try:
            pickle.dump(job, process.stdin)
            process.stdin.flush()
            e, values = pickle.load(process.stdout)
        except (OSError, EOFError, pickle.UnpicklingError):
            e, values = job[0], None
        if (found := owner()) is None:
            break
        with found._lock:
            found._done.append((e, values))
        del found
    process.kill()
    process.wait()


def _serve() -> None:
    """Search what comes in, in turn, until the input ends; Ctrl-C is for the parent."""
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    while True:
        try:
            e, jobs = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        found = pickle.dumps((e, [push_value(*job) for job in jobs]))
        try:
            sys.stdout.buffer.write(found)
            sys.stdout.buffer.flush()
        except BrokenPipeError:  # the reader is gone
            os._exit(0)


if __name__ == "__main__":
    _serve()
