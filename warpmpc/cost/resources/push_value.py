# SPDX-License-Identifier: Apache-2.0
"""Push values of a stack's terms: searched for anew when the goal moves, beside the planning."""

from __future__ import annotations

import logging
import math
import os
import pickle
import queue
import subprocess
import sys
import threading
import weakref
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ...launch import capturing
from .ground import CELL, Ground
from .push_path import STEPS, PushRequest, push_value
from .resource import Resource

if TYPE_CHECKING:
    from ...task.task import Task
    from .resource import Resources

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
                known[key] = [push_value(*job) for job in self._jobs(goal)]
            self._take(int(e), goal, known[key])

    def _jobs(self, goal: np.ndarray) -> list[tuple]:
        """Arguments of :func:`push_value` for each term."""
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
        except BrokenPipeError:  # nobody waits for it any more
            os._exit(0)


if __name__ == "__main__":
    _serve()
