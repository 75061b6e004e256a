# SPDX-License-Identifier: Apache-2.0
"""Messages between robot and planner, as arrays that cross processes, and the buffers in which they cross."""

from __future__ import annotations

import os
import threading
import time
import zlib
from collections import deque
from dataclasses import dataclass, field
from multiprocessing.context import BaseContext
from typing import TYPE_CHECKING

import numpy as np

from ...planner.controller.rollout_paths import FAN, RolloutPaths
from ...planner.feedback import Feedback
from ...planner.plan import Plan
from ...scene.model.state import State
from ...scene.schema import SplineKind

if TYPE_CHECKING:
    from ...planner.feedback import StateSpace
    from ...scene.model.layout import Layout

HEAD = 8
"""Numbers of a plan before its knots."""
SPLINES = tuple(SplineKind)
"""Kinds of splines, by the number that tells them."""
TAIL_LINES = 12
"""Newest lines that are kept of what a process writes on standard error."""
TAIL_BYTES = 65_536
"""Bytes of a line without end that are kept."""
TAIL_PATIENCE = 1.0
"""Wall time for which the end is waited for [s]: what the process started may live on and write, too."""


@dataclass(frozen=True)
class TimedObservation:
    """An observation on its way to the planner."""

    state: State
    """The state, of one environment, with its time."""
    command: np.ndarray
    """Control that the robot was sent last ``[nu]``."""
    following: bool
    """True if that came from a plan, not from the watchdog."""
    task: np.ndarray | None = None
    """The task's values, a row of ``Task.block``; None where robot and planner share the task itself."""
    stamp: float = field(default_factory=time.monotonic)
    """Time of sending, on this host's monotonic clock [s]."""


@dataclass(frozen=True)
class TimedPlan:
    """A plan on its way to the agent; immutable."""

    plan: Plan
    """Controls over the robot's clock."""
    number: int
    """Plans before it, those of a planner that died included."""
    observed: float
    """Time of the observation that it was made from [s]."""
    latency: float
    """From that observation to the plan, on the robot's clock [s]."""
    plan_ms: float
    """Wall time of the planning itself [ms]."""
    survived: bool
    """True if a rollout survived; else the plan is not to be followed."""
    eta: float = np.nan
    """Effective number of samples η."""


class PathsCodec:
    """Turns paths of rollouts into arrays and back.

    Args:
        frames: Acting frames.
        steps: Steps of a rollout.
        fan: Sampled rollouts beside the cheapest one, at most.
    """

    def __init__(self, frames: int, steps: int, fan: int = FAN):
        self.fan, self.capacity = fan, 3 + 3 * fan + 3 * (1 + fan) * frames * (steps + 1)

    def encode(self, paths: RolloutPaths) -> np.ndarray:
        """Numbers of paths."""
        return np.concatenate([paths.others.shape[:3], paths.colors.ravel(), paths.best.ravel(), paths.others.ravel()])

    def decode(self, message: np.ndarray) -> RolloutPaths:
        """The paths that numbers tell."""
        count, frames, places = message[:3].astype(int)
        colors, ways = np.split(message[3:], [3 * count])
        ways = ways.reshape(1 + count, frames, places, 3).astype(np.float32)
        return RolloutPaths(ways[0], ways[1:], colors.reshape(count, 3).astype(np.uint8))


class ObservationCodec:
    """Turns observations into arrays and back.

    Args:
        layout: State layout.
        task: Numbers of the task.
    """

    def __init__(self, layout: Layout, task: int):
        widths = (3, layout.nq, layout.nv, layout.na, 7 * layout.nm, layout.nu, task)
        self.capacity = sum(widths)
        self._splits = np.cumsum(widths)[:-1]
        self._layout = layout

    def encode(self, observation: TimedObservation) -> np.ndarray:
        """Numbers of a observation; what its state leaves out is the scene's start."""
        state, layout = observation.state, self._layout
        act = layout.act if state.act is None else state.act
        mocap = layout.mocap if state.mocap is None else state.mocap
        head = [state.time, observation.stamp, observation.following]
        tail = (np.ravel(mocap), observation.command, observation.task)
        return np.concatenate([head, state.joint_q, state.joint_qd, act, *tail]).astype(float)

    def decode(self, message: np.ndarray) -> TimedObservation:
        """The observation that numbers tell."""
        head, q, qd, act, mocap, command, task = np.split(message.astype(np.float32), self._splits)
        moment, stamp = message[:2].tolist()
        state = State(q, qd, time=moment, act=act, mocap=mocap.reshape(-1, 7))
        return TimedObservation(state, command, bool(head[2]), task, stamp)


class PlanCodec:
    """Turns plans into arrays and back.

    Args:
        layout: State layout, whose limits plans have.
        knots: Knots at most.
        space: How states are subtracted, where plans have feedback; they have as many gains as knots then.
    """

    def __init__(self, layout: Layout, knots: int, space: StateSpace | None = None):
        self._layout, self._space = layout, space
        gains = 1 + space.tangent.width + layout.nu * space.tangent.size if space else 0
        self.capacity = HEAD + knots * (1 + layout.nu + gains)

    def encode(self, timed: TimedPlan) -> np.ndarray:
        """Numbers of a plan."""
        plan = timed.plan
        head = [timed.number, timed.observed, timed.latency, timed.plan_ms, timed.survived, timed.eta]
        head += [SPLINES.index(plan.spline), len(plan.times)]
        answer = plan.feedback if self._space else None
        gains = [a.ravel() for a in (answer.times, answer.state, answer.gain)] if answer else []
        return np.concatenate([head, plan.times, plan.knots.ravel(), *gains])

    def decode(self, message: np.ndarray) -> TimedPlan:
        """The plan that numbers tell."""
        count, layout = int(message[HEAD - 1]), self._layout
        times, knots, rest = np.split(message[HEAD:], np.cumsum([count, count * layout.nu]))
        limits = layout.control_lower.copy(), layout.control_upper.copy()
        knots = knots.reshape(count, layout.nu).astype(np.float32)
        plan = Plan(knots, times.copy(), SPLINES[int(message[HEAD - 2])], *limits, self._feedback(rest, count))
        number, observed, latency, plan_ms, survived, eta = message[: HEAD - 2].tolist()
        return TimedPlan(plan, int(number), observed, latency, plan_ms, bool(survived), eta)

    def _feedback(self, numbers: np.ndarray, count: int) -> Feedback | None:
        """The feedback of a plan with so many knots, None without."""
        if not len(numbers):
            return None
        tangent, nu = self._space.tangent, self._layout.nu
        times, states, gains = np.split(numbers, np.cumsum([count, count * tangent.width]))
        shapes = (1, count), (1, count, tangent.width), (1, count, nu, tangent.size)
        arrays = (a.reshape(shape).copy() for a, shape in zip((times, states, gains), shapes, strict=True))
        return Feedback(*arrays, self._space)


class LatestValue:
    """Holds the newest message, an array of numbers; one process writes, others read.

    There is no lock, so that a process that is killed while it writes blocks no other. Two places take turns, and a
    checksum tells a message that was overwritten while it was read.

    Args:
        context: Context of the processes.
        capacity: Numbers in the longest message.
    """

    def __init__(self, context: BaseContext, capacity: int):
        self._places = [context.RawArray("d", 3 + capacity) for _ in range(2)]  # number, checksum, length, message
        self.capacity = capacity
        self._sent = self._read = 0

    def __getstate__(self) -> dict[str, object]:
        """Without the counts, which are each process's own."""
        return {**self.__dict__, "_sent": 0, "_read": 0}

    def write(self, message: np.ndarray) -> None:
        """Put a message in the place of the older one.

        Raises:
            ValueError: If it is longer than the buffer.
        """
        message = np.ascontiguousarray(message, dtype=float)
        if len(message) > self.capacity:
            raise ValueError(f"a message of {len(message)} numbers does not fit into a buffer of {self.capacity}")
        self._sent = self.sent + 1
        place = np.frombuffer(self._places[self._sent % 2])
        place[0] = 0.0  # no reader may take the older message for whole
        place[3 : 3 + len(message)] = message
        place[1], place[2] = _checksum(message, self._sent), len(message)
        place[0] = self._sent

    @property
    def sent(self) -> int:
        """Messages written so far, by whomever."""
        return max(self._sent, self._newest()[0])

    def read(self) -> np.ndarray | None:
        """The newest message, None where it has been read already or there is none."""
        number, place = self._newest()
        if number <= self._read:
            return None
        copy = place.copy()
        length = int(copy[2])
        message = copy[3 : 3 + length]
        if copy[0] != number or _checksum(message, number) != copy[1]:
            return None  # being written: the next call finds it
        self._read = number
        return message

    def _newest(self) -> tuple[int, np.ndarray]:
        places = [np.frombuffer(place) for place in self._places]
        return max(((int(place[0]), place) for place in places), key=lambda found: found[0])


def _checksum(message: np.ndarray, number: int) -> int:
    return zlib.crc32(message.tobytes(), number & 0xFFFFFFFF)


class StderrTail:
    """The newest lines that another process wrote.

    Args:
        context: Context of the processes.
    """

    def __init__(self, context: BaseContext):
        self._reader, self.writer = context.Pipe(duplex=False)
        self._lines: deque[str] = deque(maxlen=TAIL_LINES)
        self._thread = threading.Thread(target=self._listen, daemon=True)

    def listen(self) -> None:
        """Begin; the process has its copy of :attr:`writer` by now."""
        self.writer.close()
        self._thread.start()

    def lines(self) -> list[str]:
        """Return the last lines, once the process is dead."""
        self._thread.join(TAIL_PATIENCE)
        return list(self._lines)

    def _listen(self) -> None:
        rest = b""
        while some := os.read(self._reader.fileno(), 4096):
            *whole, rest = (rest + some).split(b"\n")
            rest = rest[-TAIL_BYTES:]
            self._keep(whole)
        self._keep([rest])
        self._reader.close()

    def _keep(self, lines: list[bytes]) -> None:
        self._lines.extend(line.decode(errors="replace").rstrip() for line in lines if line.strip())
