# SPDX-License-Identifier: Apache-2.0
"""Whether observation and plan can be trusted, and what the robot may be sent at most."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

from ..scene.errors import SceneError
from .letters import TimedPlan

if TYPE_CHECKING:
    from ..model.layout import Layout
    from ..model.state import State
    from ..scene.schema import Scene


class FaultKind(StrEnum):
    """What can be wrong."""

    OBSERVATION_INVALID = "observation not finite or of the wrong size"
    OBSERVATION_OLD = "old observation"
    OBSERVATION_FROZEN = "frozen observation"
    OBSERVATION_BACK = "observation back in time"
    PLAN_MISSING = "no fresh plan"
    PLAN_DIVERGED = "every rollout diverged"
    PLAN_INVALID = "plan not finite or out of range"


Finding = tuple[FaultKind, str]
"""What is wrong, and a sentence about it."""
MOVING = 1e-3
"""Joint velocity above which joint positions must change [m/s or rad/s]."""
BEYOND = 1e-3
"""Share of its range by which a control may miss its limits: rounding."""
SLACK = 1e-6
"""What a lapse of time may exceed its limit by [s]: times are sums of ticks."""


class Watchdog:
    """Looks at every observation and every plan.

    Args:
        scene: The scene, whose ``agent`` says how old things may be.
        layout: State layout.
    """

    state: State | None
    """The last observation that could be trusted."""

    def __init__(self, scene: Scene, layout: Layout):
        self._settings, self._layout = scene.agent, layout
        self._range = BEYOND * (layout.control_upper - layout.control_lower)
        self.state = None
        self._newest = -np.inf  # largest time of an observation
        self._moved = -np.inf  # when joint positions changed last, on the robot's clock
        self._joint_q: np.ndarray | None = None

    def observation_fault(self, state: State, now: float) -> Finding | None:
        """Why an observation cannot be trusted, None where it can.

        Args:
            state: The observation, with its time.
            now: The robot's clock [s].
        """
        fault = self._observation_fault(state, now)
        self.state = state if fault is None else self.state
        return fault

    def _observation_fault(self, state: State, now: float) -> Finding | None:
        layout, limit = self._layout, self._settings.observation_timeout + SLACK
        parts = (state.joint_q, state.joint_qd, state.act, state.mocap, state.time)
        if np.shape(state.joint_q) != (layout.nq,) or np.shape(state.joint_qd) != (layout.nv,):
            return (
                FaultKind.OBSERVATION_INVALID,
                f"the observation has not {layout.nq} joint coordinates and {layout.nv} velocities",
            )
        if not all(part is None or np.isfinite(part).all() for part in parts):
            return FaultKind.OBSERVATION_INVALID, "the observation is not finite"
        back = self._newest - state.time
        if back > SLACK:
            return FaultKind.OBSERVATION_BACK, f"the observation went back in time by {back:.3f} s"
        self._newest = state.time
        if now - state.time > limit:
            return FaultKind.OBSERVATION_OLD, f"the observation is {now - state.time:.3f} s old"
        if self._joint_q is None or not np.array_equal(state.joint_q, self._joint_q):
            self._joint_q, self._moved = state.joint_q, now
        if now - self._moved > limit and np.max(np.abs(state.joint_qd), initial=0.0) > MOVING:
            return (
                FaultKind.OBSERVATION_FROZEN,
                f"the observation is frozen: moving joints are {now - self._moved:.3f} s where they were",
            )
        return None

    def plan_fault(self, timed: TimedPlan | None, now: float) -> Finding | None:
        """Why a plan is not to be followed, None where it is.

        Args:
            timed: The newest plan, None before the first.
            now: The robot's clock [s].
        """
        if timed is None:
            return FaultKind.PLAN_MISSING, "there is no plan yet"
        if not timed.survived:
            return FaultKind.PLAN_DIVERGED, "every rollout diverged"
        age = now - timed.observed
        if age > self._settings.plan_timeout + SLACK:  # whether it came long ago or took long to make
            return FaultKind.PLAN_MISSING, f"the newest plan is from what was observed {age:.3f} s ago"
        knots, layout = timed.plan.knots, self._layout
        if not np.isfinite(knots).all():
            return FaultKind.PLAN_INVALID, "the plan is not finite"
        outside = (knots < layout.control_lower - self._range) | (knots > layout.control_upper + self._range)
        if outside.any():
            row, column = np.argwhere(outside)[0]
            name, value = layout.control_name[column], knots[row, column]
            return FaultKind.PLAN_INVALID, f"the plan is out of range: {name} = {value:.4g}"
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
        control = np.clip(control, self._lower, self._upper)
        if self._step is not None and self._last is not None:
            control = np.clip(control, self._last - self._step, self._last + self._step)
        self._last = np.asarray(control, dtype=np.float32)
        return self._last.copy()
