# SPDX-License-Identifier: Apache-2.0
"""A driver's robot with the end of its run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from ..plant.monitor import Monitor
from ..realtime.watchdog import received

if TYPE_CHECKING:
    import numpy as np

    from ..cost.term import UserTerm
    from ..model.compiled import CompiledScene
    from ..model.state import State
    from ..planner.plan import Plan
    from ..realtime.loop import Robot
    from ..scene.schema import Scene
    from ..task.task import Task


class MonitoredRobot:
    """A driver's robot with the end of its run: success, failure, timeout, or what the driver's ``done`` says.

    Args:
        scene: The scene.
        robot: The robot.
        task: What the run wants, shared with the planner.
        terms: Users' own cost terms that success, failures or phases name.
        compiled: The scene compiled earlier, to save doing it again.

    Raises:
        SceneError: As :class:`~warpmpc.Monitor`.
    """

    mean_cost: float | None = None
    """None: cost terms are not evaluated on what a driver observes."""

    def __init__(
        self, scene: Scene, robot: Robot, *, task: Task, terms: Sequence[UserTerm] = (), compiled: CompiledScene
    ):
        self.robot, self._timeout = robot, scene.timing.timeout
        self.stop = getattr(robot, "stop", lambda: None)
        if hasattr(robot, "follow"):
            self.follow = self._follow
        self._monitor = Monitor(scene, task=task, terms=terms, compiled=compiled)
        self._control: np.ndarray | None = None
        self._start: float | None = None
        self.time = 0.0
        """Time since the first observation [s]."""

    def observe(self) -> State | None:
        """The newest state, None before the first."""
        seen = self.robot.observe()
        if seen is None:
            return None
        state = received(seen)
        self._start = state.time if self._start is None else self._start
        self.time = state.time - self._start
        self._monitor.update(state, self._control)
        return state

    def apply(self, control: np.ndarray) -> None:
        """Send a control ``[nu]``."""
        self._control = control
        self.robot.apply(control)

    def _follow(self, plan: Plan, now: float) -> None:
        self._control = plan.at(now)
        self.robot.follow(plan, now)

    @property
    def success(self) -> bool:
        """Return whether what is wanted holds and did so long enough."""
        return self._monitor.success

    @property
    def done(self) -> bool:
        """Return whether the run is over."""
        return self.reason != "running"

    @property
    def reason(self) -> str:
        """A few words about how the run ended, ``running`` until then."""
        if self.success:
            return "goal reached"
        if self._monitor.failure is not None:
            return f"failed: {self._monitor.failure}"
        if self.time >= self._timeout:
            return "timeout"
        return "ended by the robot" if getattr(self.robot, "done", False) else "running"
