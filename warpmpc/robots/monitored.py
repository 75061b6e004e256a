# SPDX-License-Identifier: Apache-2.0
"""A driver's robot with the end of its run."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..model.state import State
from ..plant.monitor import Monitor
from ..realtime.watchdog import received
from ..task.task import Task, task_layout

if TYPE_CHECKING:
    from ..cost.term import UserTerm
    from ..model.compiled import CompiledScene
    from ..model.pairs import Pair
    from ..planner.plan import Plan
    from ..realtime.loop import Robot
    from ..scene.schema import Scene
    from ..task.goal import GoalError

SILENT = 3.0
"""Time without a new state from which on this host's clock counts, too [s]."""


class MonitoredRobot:
    """A driver's robot with the end of its run: success, failure, timeout, or what the driver's ``done`` says.

    Its last good observation stands where a simulated plant has its true state.

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
    pairs: tuple[Pair, ...] = ()
    """None: contact forces are not observed."""
    forces = np.zeros((0, 3))
    """Forces on them ``[0, 3]``."""
    moves_when_observed = True
    """Its state is the last observation: it does not move on in :meth:`apply`, as a plant does."""

    def __init__(
        self, scene: Scene, robot: Robot, *, task: Task, terms: Sequence[UserTerm] = (), compiled: CompiledScene
    ):
        self.scene, self.robot, self.layout = scene, robot, task_layout(compiled.layout, scene)
        self.stop = getattr(robot, "stop", lambda: None)
        if hasattr(robot, "tell"):
            self.tell = robot.tell
        if hasattr(robot, "follow"):
            self.follow = self._follow
        # its kernels are loaded now: the first look would take many ticks
        Monitor(scene, task=Task(scene), terms=terms, compiled=compiled).update(State.start(self.layout), None)
        self._monitor = Monitor(scene, task=task, terms=terms, compiled=compiled)
        self._control: np.ndarray | None = None
        self._start: float | None = None
        self._stamp, self._came = math.nan, math.inf  # time of the newest state, and when it came, on this host
        self.state = State.start(self.layout)
        """The last observation that was finite and of the right size; the scene's start before."""
        self.time = 0.0
        """Time since the first observation [s]."""

    def observe(self) -> State | None:
        """The newest state, None before the first."""
        seen = self.robot.observe()
        if seen is None:
            return None
        state = received(seen)
        if not (self._fits(state) and np.isfinite(state.time)):
            return state  # the watchdog tells of it
        self._start = state.time if self._start is None else self._start
        if state.time != self._stamp:
            self._stamp, self._came = state.time, time.monotonic()
        self.time = state.time - self._start
        self._monitor.update(state, self._control)
        if np.isfinite(state.joint_q).all() and np.isfinite(state.joint_qd).all():
            self.state = state
        return state

    def _fits(self, state: State) -> bool:
        """Return whether a state has the scene's numbers."""
        layout, mocap = self.layout, state.mocap
        joints = (state.joint_q.shape, state.joint_qd.shape) == ((layout.nq,), (layout.nv,))
        return joints and (mocap is None or mocap.shape == (layout.nm, 7))

    @property
    def body_q(self) -> np.ndarray:
        """Poses of all bodies ``[nb, 7]``, as the joints have them; NaN before the first observation."""
        found = self._monitor.body_q
        return np.full((self.layout.nb, 7), np.nan) if found is None else found

    @property
    def error(self) -> GoalError | None:
        """Distance of the goal's object or frame from the goal; None for a scene without a goal."""
        return self._monitor.error

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
        silence = time.monotonic() - self._came
        if self.time + (silence if silence > SILENT else 0.0) >= self.scene.timing.timeout:
            return "timeout"
        return "ended by the robot" if getattr(self.robot, "done", False) else "running"
