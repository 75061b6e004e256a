# SPDX-License-Identifier: Apache-2.0
"""Messages between robot and planner: observations one way, plans the other, as arrays that cross processes."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from ..controller.rollout_paths import FAN, RolloutPaths
from ..model.state import State
from ..planner.feedback import Feedback
from ..planner.plan import Plan

if TYPE_CHECKING:
    from ..model.layout import Layout
    from ..planner.feedback import StateSpace
    from ..scene.schema import SplineKind

HEAD = 7
"""Numbers of a plan before its knots."""


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
        spline: Their spline.
        knots: Knots at most.
        space: How states are subtracted, where plans have feedback; they have as many gains as knots then.
    """

    def __init__(self, layout: Layout, spline: SplineKind, knots: int, space: StateSpace | None = None):
        self._layout, self._spline, self._space = layout, spline, space
        gains = 1 + space.tangent.width + layout.nu * space.tangent.size if space else 0
        self.capacity = HEAD + knots * (1 + layout.nu + gains)

    def encode(self, timed: TimedPlan) -> np.ndarray:
        """Numbers of a plan."""
        plan = timed.plan
        head = [timed.number, timed.observed, timed.latency, timed.plan_ms, timed.survived, timed.eta, len(plan.times)]
        answer = plan.feedback if self._space else None
        gains = [a.ravel() for a in (answer.times, answer.state, answer.gain)] if answer else []
        return np.concatenate([head, plan.times, plan.knots.ravel(), *gains])

    def decode(self, message: np.ndarray) -> TimedPlan:
        """The plan that numbers tell."""
        count, layout = int(message[HEAD - 1]), self._layout
        times, knots, rest = np.split(message[HEAD:], np.cumsum([count, count * layout.nu]))
        limits = layout.control_lower.copy(), layout.control_upper.copy()
        knots = knots.reshape(count, layout.nu).astype(np.float32)
        plan = Plan(knots, times.copy(), self._spline, *limits, self._feedback(rest, count))
        number, observed, latency, plan_ms, survived, eta, _ = message[:HEAD].tolist()
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
