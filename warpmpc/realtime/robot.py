# SPDX-License-Identifier: Apache-2.0
"""Robots of a run: the simulated plant that takes commands at the agent's rate, and drivers by their names."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

from ..model.compiled import CompiledScene, compile_scene
from ..plant.monitor import Monitor
from ..plant.plant import Plant
from ..plant.worlds import SUBSTEPS
from ..registry import ROBOTS
from .watchdog import received

if TYPE_CHECKING:
    import numpy as np

    from ..cost.term import UserTerm
    from ..model.state import State
    from ..scene.schema import Scene
    from ..task.task import Task
    from .loop import Robot


def simulated_robot(
    scene: Scene,
    *,
    seed: int = 0,
    task: Task | None = None,
    terms: Sequence[UserTerm] = (),
    watch: Collection[str] = (),
    compiled: CompiledScene | None = None,
) -> Plant:
    """The scene's plant, moved on by one tick of ``agent.rate`` with every command; physics steps are not longer.

    Args:
        scene: The scene.
        seed: Seed of the plant's properties and noise.
        task: What the run wants, shared with the planner (``planner.task``); one of its own if None.
        terms: Users' own cost terms that success, failures, phases or ``watch`` name.
        watch: Cost terms whose values the plant's ``terms`` shall have.
        compiled: The scene compiled earlier, to save doing it again.

    Raises:
        SceneError: As :class:`~warpmpc.Plant`.
    """
    compiled = compiled or compile_scene(scene)
    timing, tick = scene.timing, 1.0 / scene.agent.rate
    physics = timing.control_dt / compiled.substeps(scene.plant.substeps, timing.control_dt, SUBSTEPS)
    substeps = max(1, math.ceil(tick / physics - 1e-6))
    faster = scene.model_copy(
        update={
            "timing": timing.model_copy(update={"control_dt": tick}),
            "plant": scene.plant.model_copy(update={"substeps": substeps}),
        }
    )
    return Plant(faster, seed=seed, task=task, terms=terms, watch=watch, compiled=compiled)


ROBOTS.register("simulated", simulated_robot)


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
        self._monitor = Monitor(scene, task=task, terms=terms, compiled=compiled)
        self._control: np.ndarray | None = None
        self._start: float | None = None
        self.time = 0.0
        """Time since the first observation [s]."""

    def observe(self) -> State:
        """The newest state."""
        state = received(self.robot.observe())
        self._start = state.time if self._start is None else self._start
        self.time = state.time - self._start
        self._monitor.update(state, self._control)
        return state

    def apply(self, control: np.ndarray) -> None:
        """Send a control ``[nu]``."""
        self._control = control
        self.robot.apply(control)

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
