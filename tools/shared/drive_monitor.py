# SPDX-License-Identifier: Apache-2.0
"""A check of what a robot's drives are given against the commands that came, apart from its safety."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from warpmpc.loop.realtime.watchdog import SLACK, SafeCommands
from warpmpc.loop.robots.safety import COMMANDS_TIMEOUT, TAKEOVER, Command, Safety
from warpmpc.loop.robots.simulated import RobotProcess
from warpmpc.scene.draw import draw_task

if TYPE_CHECKING:
    from warpmpc.loop.robots.simulated import Transport
    from warpmpc.scene.model.layout import Layout
    from warpmpc.scene.model.state import State
    from warpmpc.scene.schema import Scene

ROUNDING = 1e-5
"""Share of a control, and of one, by which it may miss another that is the same."""


class DriveMonitor:
    """Counts ticks at which the drives were given what they never should, whatever :class:`Safety` made of it.

    Good is a control that is finite, inside the limits, and either that of a command which is not too old until the
    next tick, from the sender that commands, or the drives' safe command. It keeps its own commands.

    Args:
        scene: The scene.
        layout: State layout.
    """

    unsafe: int
    """Ticks with a control that is not good."""

    def __init__(self, scene: Scene, layout: Layout):
        self._layout, self._tick = layout, 1.0 / scene.agent.rate
        self._safe = SafeCommands(scene, layout)
        self._came: deque[tuple[float, Command]] = deque()  # and when, on the robot's clock
        self._commander, self._spoke = "", -np.inf  # who commands, and when the last command of his came that acted
        self.unsafe = 0

    def hear(self, commands: Iterable[Command], now: float) -> None:
        """Take note of commands as they came.

        Args:
            commands: Commands, good or not.
            now: The robot's clock [s].
        """
        while self._came and now - self._came[0][0] > COMMANDS_TIMEOUT:
            self._came.popleft()
        self._came += [(now, command) for command in commands]

    def check(self, control: np.ndarray, state: State, now: float) -> None:
        """Judge what the drives are given.

        Args:
            control: Control ``[nu]``.
            state: The robot's true state.
            now: The robot's clock [s].
        """
        inside = (control >= self._layout.control_lower) & (control <= self._layout.control_upper)  # NaN is not
        if inside.all() and self._is_command(control, now):
            self._safe.release()
        elif not (inside.all() and self._equal(self._safe(state, now), control)):
            self.unsafe += 1

    def _is_command(self, control: np.ndarray, now: float) -> bool:
        """Return whether a control is that of a command that may act."""
        for came, command in reversed(self._came):
            heard = command.sender == self._commander or now - self._spoke >= TAKEOVER
            if heard and self._may_act(command, came, now) and self._equal(command.at(now), control):
                self._commander, self._spoke = command.sender, came
                return True
        return False

    def _may_act(self, command: Command, came: float, now: float) -> bool:
        age = now + self._tick - min(command.stamp, came)
        return command.stamp - came <= COMMANDS_TIMEOUT and age <= COMMANDS_TIMEOUT + SLACK  # NaN may not

    def _equal(self, wanted: np.ndarray, control: np.ndarray) -> bool:
        """Return whether a control ``[nu]`` is another within the limits, but for rounding."""
        if wanted.shape != control.shape:
            return False
        kept = np.clip(wanted, self._layout.control_lower, self._layout.control_upper)
        return bool((np.abs(kept - control) <= ROUNDING * (1.0 + np.abs(kept))).all())


class MonitoredSafety(Safety):
    """The robot's safety, whose commands a :class:`DriveMonitor` judges."""

    def __init__(self, scene: Scene, layout: Layout):
        super().__init__(scene, layout)
        self.monitor = DriveMonitor(scene, layout)

    def take(self, commands: Iterable[Command], now: float) -> None:
        """Hear commands."""
        self.monitor.hear(commands, now)
        super().take(commands, now)

    def command(self, state: State, now: float) -> np.ndarray:
        """The control ``[nu]`` that the drives are given."""
        control = super().command(state, now)
        self.monitor.check(control, state, now)
        return control


class MonitoredProcess(RobotProcess):
    """The simulated robot with a count of unsafe ticks in its report."""

    safety: MonitoredSafety

    def __init__(self, scene: Scene, connect: Callable[..., Transport], *, seed: int = 0, **keys: Any):
        layouts = []

        def connected(layout: Layout) -> Transport:
            layouts.append(layout)
            return connect(layout)

        super().__init__(scene, connected, seed=seed, **keys)
        self.safety = MonitoredSafety(draw_task(scene, seed)[0], layouts[0])

    def told(self) -> dict[str, Any]:
        """The report as data for JSON, with ``unsafe``: ticks at which the drives were given what they never should."""
        return {**self.report().to_json(), "unsafe": self.safety.monitor.unsafe}
