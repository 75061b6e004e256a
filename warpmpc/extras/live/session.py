# SPDX-License-Identifier: Apache-2.0
"""The thread that owns the plant: takes what others want changed, steps, keeps the pace."""

from __future__ import annotations

import logging
import math
import queue
import threading
import time
from collections.abc import Callable

import numpy as np

from .closed_loop import ClosedLoop

logger = logging.getLogger("warpmpc")

SETTLE = 0.3
"""Wall time without another change of a key after which it is made: texts are typed letter by letter [s]."""
SLOWEST = 1e-6
"""Least simulated seconds per second of wall time."""
WAIT = 0.02
"""Longest sleep between two looks at what others want [s]."""


class Session(ClosedLoop, threading.Thread):
    """Runs controller and plant until it is stopped, at the goal and after the time-out, too.

    Everything that touches the plant happens in this thread. Other threads hand in changes, which are taken between two
    plans, and read :attr:`snapshot`. A change that cannot be made is told there and leaves everything as it was.

    Args:
        pace: Simulated seconds per second of wall time at most, as :attr:`pace`.
        lock_step: Whether every control waits for its own plan, instead of following the newest one.
        options: As for :class:`~.closed_loop.ClosedLoop`.

    Raises:
        SceneError: If the scene is wrong.
        ValueError: If engine or device is unknown, or there is no such pace.
    """

    def __init__(self, source: str, *, pace: float = 1.0, lock_step: bool = False, **options: object):
        threading.Thread.__init__(self, name="warpmpc live", daemon=True)
        self.waiting: dict[str, str] = {}
        """Keys about to be changed."""
        self._changes: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._ending = threading.Event()
        self._settled = self._from = 0.0
        self._steps_wanted = 0
        ClosedLoop.__init__(self, source, **options)
        self.pace, self.lock_step = pace, lock_step
        self.awaiting = False
        """True while the plant waits for the first viewer."""

    # ---- for other threads

    @property
    def pace(self) -> float:
        """Simulated seconds per second of wall time at most: finite, :data:`SLOWEST` or more, else ``ValueError``."""
        return self.speed

    @pace.setter
    def pace(self, pace: float) -> None:
        if not SLOWEST <= pace < math.inf:
            raise ValueError(f"pace is a finite number of at least {SLOWEST:g}, not {pace}; pause holds the plant")
        self.speed = pace

    def do(self, change: Callable[[], None]) -> None:
        """Hand in a change; it is made between two plans, in this object's thread."""
        self._changes.put(change)

    def set_value(self, name: str, value: object) -> None:
        """Change a weight, scalar or pose of the task."""

        def change() -> None:
            self.controller.task[name] = value
            if np.ndim(value) == 0:
                self.tuned[name] = float(value)

        self.do(change)

    def set_key(self, key: str, value: str) -> None:
        """Change a key of the scene, a TOML value, once it has not been changed again for :data:`SETTLE`.

        Keys of the planner and of norms are those of the next plan, which goes on from the last one; others begin a new
        episode, as do norms of terms that success or phases ask for.
        """

        def change() -> None:
            self.waiting[key] = value
            self._settled = time.perf_counter() + SETTLE

        self.do(change)

    def pause(self, paused: bool = True) -> None:
        """Hold the plant, or let it go on."""
        self.do(lambda: setattr(self, "paused", paused))

    def plan_or_not(self, planning: bool) -> None:
        """Plan, or follow the last plan to its end and hold then."""
        self.do(lambda: setattr(self, "planning", planning))

    def control_or_not(self, controlling: bool) -> None:
        """Send what is planned, or the safe command of the drives; plans are made all the same."""
        self.do(lambda: setattr(self, "controlling", controlling))

    def step_or_follow(self, lock_step: bool) -> None:
        """Let every control wait for its own plan, or follow the newest plan."""
        self.do(lambda: setattr(self, "lock_step", lock_step))

    def single_step(self) -> None:
        """Make one step while paused."""
        self.do(lambda: setattr(self, "_steps_wanted", self._steps_wanted + 1))

    def reset(self, seed: int | None = None) -> None:
        """Start the episode again, or that of another seed; tuned values stay."""
        self.do(lambda: self._reset(seed))

    def switch(self, source: str) -> None:
        """Go on with another scene, as its file has it."""
        self.do(lambda: self._build(source, (), {}, self.seed))

    def record(self, recording: bool = True) -> None:
        """Record to a new file in the working directory, or stop; other planners, plants and resets stop it, too."""
        self.do(self._start_recording if recording else self._recording.stop)

    def grab(self, body: str, point: np.ndarray) -> None:
        """Take hold of a body at a point of the world ``[3]`` [m]."""
        self.do(lambda: self.plant.perturbation.grab(body, point))

    def pull(self, point: np.ndarray) -> None:
        """Pull what is held to a point of the world ``[3]`` [m]."""
        self.do(lambda: self.plant.perturbation.body is None or self.plant.perturbation.pull(point))

    def turn(self, rotation: np.ndarray) -> None:
        """Turn what is held by a rotation vector in the world ``[3]`` [rad] since the grab."""
        self.do(lambda: self.plant.perturbation.body is None or self.plant.perturbation.turn(rotation))

    def release(self) -> None:
        """Let go of what is held."""
        self.do(lambda: self.plant.perturbation.release())

    def stop(self) -> None:
        """End the thread after the step it is at."""
        self._ending.set()

    # ---- in this thread

    def run(self) -> None:
        """Take changes, step, keep the pace; finish a recording at the end."""
        try:
            self._go_on()
        finally:
            self._end_planner()
            self._recording.stop()

    def _go_on(self) -> None:
        self._from = time.perf_counter()
        while not self._ending.is_set():
            self._take_changes()
            control_dt, now = self.plant.scene.timing.control_dt, time.perf_counter()
            held = self.plant.diverged or self.awaiting or (self.paused and not self._steps_wanted)
            due = self._from + control_dt / self.pace
            if held or (now < due and not self._steps_wanted):
                if held:
                    self._from = now - control_dt / self.pace
                self._publish()
                self._ending.wait(WAIT if held else min(WAIT, due - now))
                continue
            self._from = min(now, max(due, now - 0.1))
            self._steps_wanted = max(0, self._steps_wanted - 1)
            self._guarded(self._step)

    def _take_changes(self) -> None:
        while True:
            try:
                change = self._changes.get_nowait()
            except queue.Empty:
                break
            self._guarded(change)
        if self.waiting and time.perf_counter() >= self._settled:
            self._guarded(lambda: self._set_keys(self.waiting))
            self.waiting = {}  # no sooner: what is shown is what was asked for
        if self._later.ready and not self._recording.path:
            self._guarded(self._hand_over)

    def _guarded(self, work: Callable[[], None]) -> None:
        """Do something; what goes wrong is told on the page and must not end the loop."""
        try:
            work()
        except Exception as error:
            self.message = " ".join(str(error).split()) or type(error).__name__
            logger.warning("%s", self.message)
            if work == self._step:
                self.paused = True  # it would go wrong at every step
        else:
            if work != self._step:
                self.message = ""
