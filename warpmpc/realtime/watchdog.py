# SPDX-License-Identifier: Apache-2.0
"""Checks of observations and plans, and limits of what the robot is sent."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

from ..model.state import State
from ..scene.errors import SceneError
from .messages import TimedPlan

if TYPE_CHECKING:
    from ..model.layout import Layout
    from ..scene.schema import Scene


class FaultKind(StrEnum):
    """Kinds of faults."""

    OBSERVATION_INVALID = "observation not finite or of the wrong size"
    OBSERVATION_OLD = "old observation"
    OBSERVATION_FROZEN = "frozen observation"
    OBSERVATION_BACK = "observation back in time"
    OBSERVATION_AHEAD = "observation ahead of the clock"
    PLAN_MISSING = "no fresh plan"
    PLAN_DIVERGED = "every rollout diverged"
    PLAN_INVALID = "plan not finite or out of range"


Finding = tuple[FaultKind, str]
"""Kind of fault, and a sentence about it."""
MOVING = 1e-3
"""Joint velocity above which joint positions must change [m/s or rad/s]."""
BEYOND = 1e-3
"""Share of its range by which a control may miss its limits: rounding."""
SLACK = 1e-6
"""Tolerance of lapses of time [s]: times are sums of ticks."""


def received(state: State) -> State:
    """A copy of an observation, for drivers use their arrays again; what is no number in it is NaN."""
    act, mocap = (None if part is None else _numbers(part) for part in (state.act, state.mocap))
    time = _numbers(state.time)
    moment = float(time.reshape(())) if time.size == 1 else np.nan
    return State(_numbers(state.joint_q), _numbers(state.joint_qd), time=moment, act=act, mocap=mocap)


def _numbers(part: object) -> np.ndarray:
    try:
        found = np.array(part)
        return found if found.dtype.kind in "fiu" else found.astype(float)
    except (TypeError, ValueError):  # rows of several lengths, words
        return np.array(np.nan)


class Watchdog:
    """Looks at every observation, every plan and every command.

    Args:
        scene: The scene, whose ``agent`` says how old things may be.
        layout: State layout.
    """

    state: State | None
    """The last observation that could be trusted."""

    def __init__(self, scene: Scene, layout: Layout):
        self._settings, self._layout = scene.agent, layout
        self._shapes = {"joint_q": (layout.nq,), "joint_qd": (layout.nv,), "act": (layout.na,), "mocap": (layout.nm, 7)}
        beyond = BEYOND * (layout.control_upper - layout.control_lower)
        self._lower, self._upper = layout.control_lower - beyond, layout.control_upper + beyond
        self.state = None
        self._newest = -np.inf  # largest time of an observation
        self._moved = -np.inf  # when joint positions changed last, on the robot's clock
        self._joint_q: np.ndarray | None = None

    def observation_fault(self, state: State, now: float) -> Finding | None:
        """Return why an observation cannot be trusted, None where it can.

        Args:
            state: The observation, with its time, as :func:`received`: it is remembered.
            now: The robot's clock [s].
        """
        fault = self._observation_fault(state, now)
        self.state = state if fault is None else self.state
        return fault

    def _observation_fault(self, state: State, now: float) -> Finding | None:
        limit = self._settings.observation_timeout + SLACK
        for name, shape in self._shapes.items():
            part = getattr(state, name)
            if part is None:
                continue
            if np.shape(part) != shape:
                why = f"the observation's {name} is {list(np.shape(part))}, not {list(shape)}"
                return FaultKind.OBSERVATION_INVALID, why
            if not np.isfinite(part).all():
                return FaultKind.OBSERVATION_INVALID, "the observation is not finite"
        if not np.isfinite(state.time):
            return FaultKind.OBSERVATION_INVALID, "the observation has no finite time"
        if now < self._newest:  # the clock was set
            self._newest, self._moved = -np.inf, now
        age, back = now - state.time, self._newest - state.time
        if not age >= -SLACK:
            return FaultKind.OBSERVATION_AHEAD, f"the observation is {-age:.3f} s ahead of the clock"
        if back > SLACK:
            return FaultKind.OBSERVATION_BACK, f"the observation went back in time by {back:.3f} s"
        self._newest = state.time
        if not age <= limit:
            return FaultKind.OBSERVATION_OLD, f"the observation is {age:.3f} s old"
        if self._joint_q is None or not np.array_equal(state.joint_q, self._joint_q):
            self._joint_q, self._moved = state.joint_q, now
        if now - self._moved > limit and np.max(np.abs(state.joint_qd), initial=0.0) > MOVING:
            return (
                FaultKind.OBSERVATION_FROZEN,
                f"the observation is frozen: moving joints are {now - self._moved:.3f} s where they were",
            )
        return None

    def plan_fault(self, timed: TimedPlan | None, now: float) -> Finding | None:
        """Return why a plan is not to be followed, None where it is.

        Args:
            timed: The newest plan, None before the first.
            now: The robot's clock [s].
        """
        if timed is None:
            return FaultKind.PLAN_MISSING, "there is no plan yet"
        if not timed.survived:
            return FaultKind.PLAN_DIVERGED, "every rollout diverged"
        age, limit, plan = now - timed.observed, self._settings.plan_timeout + SLACK, timed.plan
        if not age >= -SLACK:
            return FaultKind.PLAN_INVALID, f"the plan is from what will be observed in {-age:.3f} s"
        if not age <= limit:  # whether it came long ago or took long to make
            return FaultKind.PLAN_MISSING, f"the newest plan is from what was observed {age:.3f} s ago"
        if not len(plan.times) or np.shape(plan.knots) != (len(plan.times), len(self._lower)):
            return (
                FaultKind.PLAN_INVALID,
                f"the plan has {len(plan.times)} times and knots {list(np.shape(plan.knots))}",
            )
        if not np.isfinite(plan.times).all():
            return FaultKind.PLAN_INVALID, "the plan is not finite"
        begins = plan.times[0] - now  # a little from now where it was made sooner than expected
        if not begins <= limit:
            return FaultKind.PLAN_INVALID, f"the plan begins in {begins:.3f} s"
        return self._controls_fault(plan.knots, "plan")

    def command_fault(self, control: np.ndarray) -> Finding | None:
        """Return why a plan's command ``[nu]`` is not to be sent, None where it is."""
        return self._controls_fault(control[None], "plan's command")

    def _controls_fault(self, controls: np.ndarray, what: str) -> Finding | None:
        """Return why controls ``[N, nu]`` are none of this robot."""
        if not np.isfinite(controls).all():
            return FaultKind.PLAN_INVALID, f"the {what} is not finite"
        outside = (controls < self._lower) | (controls > self._upper)
        if outside.any():
            row, column = np.argwhere(outside)[0]
            name, value = self._layout.control_name[column], controls[row, column]
            return FaultKind.PLAN_INVALID, f"the {what} is out of range: {name} = {value:.4g}"
        return None


class Bounds:
    """Limits of controls and of how fast they change: the last that every command goes through.

    Args:
        scene: The scene, whose ``agent.slew`` says how fast.
        layout: State layout.

    Raises:
        SceneError: If ``agent.slew`` has neither one value nor one per control.
    """

    def __init__(self, scene: Scene, layout: Layout):
        slew = scene.agent.slew
        if slew is not None and len(slew) not in (1, layout.nu):
            message = f"needs one value or {layout.nu}, one per control"
            raise SceneError(message, key="agent.slew", file=scene.path, found=list(slew))
        self._step = None if slew is None else np.broadcast_to(slew, layout.nu) / scene.agent.rate
        self._lower, self._upper = layout.control_lower, layout.control_upper
        self._last: np.ndarray | None = None

    def __call__(self, control: np.ndarray) -> np.ndarray:
        """The control ``[nu]`` that may be sent in place of another; one that is not finite is the one before."""
        if not np.isfinite(control).all():
            control = np.zeros_like(self._lower) if self._last is None else self._last
        control = self.clip(control)
        if self._step is not None and self._last is not None:
            control = np.clip(control, self._last - self._step, self._last + self._step)
        self._last = np.asarray(control, dtype=np.float32)
        return self._last.copy()

    def clip(self, control: np.ndarray) -> np.ndarray:
        """A control ``[nu]`` inside its limits."""
        return np.clip(control, self._lower, self._upper).astype(np.float32)
