# SPDX-License-Identifier: Apache-2.0
"""The robot's own safety: which commands reach its drives, and what does where none may."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

from ..realtime.pace import NewestNumbers
from ..realtime.watchdog import BEYOND, SLACK, SafeCommands

if TYPE_CHECKING:
    from ...scene.model.layout import Layout
    from ...scene.model.state import State
    from ...scene.schema import Scene

COMMANDS_TIMEOUT = 0.1
"""Age beyond which a command does not act any more [s]."""
TAKEOVER = 1.0
"""Time without a good command after which another commander is heard [s]."""


@dataclass(frozen=True)
class Command:
    """A command as it came, whatever is in it."""

    control: np.ndarray
    """Controls; ``[nu]`` where they are the robot's."""
    stamp: float
    """Time of the observation that it answers, on the robot's clock [s]."""
    sender: str
    """Who sent it."""
    trajectory: tuple[np.ndarray, np.ndarray] | None = None
    """Times ``[n]`` [s] and controls ``[n, nu]`` that go on from :attr:`control`, linear in between."""

    def at(self, now: float) -> np.ndarray:
        """Control ``[nu]`` at a time [s]."""
        if self.trajectory is None:
            return self.control
        times, controls = self.trajectory
        return np.array([np.interp(now, times, column) for column in controls.T])

    @property
    def controls(self) -> np.ndarray:
        """All of its controls ``[n, nu]``."""
        return self.control[None] if self.trajectory is None else self.trajectory[1]


class Refusal(StrEnum):
    """Reasons for which a command is refused."""

    NAN = "nan"
    SIZE = "size"
    LIMITS = "limits"
    TIMES = "times"
    STALE = "stale"
    FOREIGN = "foreign"


class Safety:
    """Stands between commands and drives; knows nothing of plans.

    A command is refused that is not finite, of the wrong size, outside the limits, with times that go back, older than
    :data:`COMMANDS_TIMEOUT` or as far ahead of the robot's clock, older than one before it, or from another sender
    than the one that commands. The newest good one acts until it is too old; then the drives' safe command does.

    Args:
        scene: The scene.
        layout: State layout.
    """

    received: int
    """Commands that came."""
    refused: Counter[Refusal]
    """Those of them that were refused."""
    safe_state: float
    """Longest time from the last good command to the safe one [s]; NaN where that never came."""
    ages: NewestNumbers
    """Ages of the newest good commands when they came [s]: from observation to command, both ways."""
    times: NewestNumbers
    """When they came, on the robot's clock [s]."""

    def __init__(self, scene: Scene, layout: Layout):
        beyond = BEYOND * (layout.control_upper - layout.control_lower)
        self._lower, self._upper = layout.control_lower - beyond, layout.control_upper + beyond
        self._layout, self._tick = layout, 1.0 / scene.agent.rate
        self._safe = SafeCommands(scene, layout)
        self.received, self.refused = 0, Counter()
        self.safe_state = np.nan
        self.ages, self.times = NewestNumbers(), NewestNumbers()
        self._good: Command | None = None
        self._acting = False

    @property
    def commanded(self) -> bool:
        """Return whether a good command ever came."""
        return self._good is not None

    def take(self, commands: Iterable[Command], now: float) -> None:
        """Hear commands.

        Args:
            commands: Those that came, in their order.
            now: The robot's clock [s].
        """
        for command in commands:
            self.received += 1
            if (refusal := self._refusal(command, now)) is not None:
                self.refused[refusal] += 1
                continue
            self._good = command
            self.ages.append(now - command.stamp)
            self.times.append(now)

    def command(self, state: State, now: float) -> np.ndarray:
        """The control ``[nu]`` that the drives are given.

        Args:
            state: The robot's true state.
            now: The robot's clock [s].

        Returns:
            Finite numbers inside the limits, whatever the command and the state are.
        """
        good = self._good
        control = None
        if good is not None and self._age(good, now + self._tick) <= COMMANDS_TIMEOUT + SLACK:
            control = good.at(now)
        acts = control is not None and bool(np.isfinite(control).all())
        if acts:
            self._safe.release()
        else:
            control = self._safe(state, now)
            control = np.where(np.isfinite(control), control, 0.0)  # such as where physics diverged
            if self._acting:
                self.safe_state = float(np.fmax(self.safe_state, now - self.times.last))
        self._acting = acts
        return np.clip(control, self._layout.control_lower, self._layout.control_upper).astype(np.float32)

    def _refusal(self, command: Command, now: float) -> Refusal | None:
        good = self._good
        if good is not None and command.sender != good.sender and now - self.times.last < TAKEOVER:
            return Refusal.FOREIGN
        if command.control.shape != (self._layout.nu,):
            return Refusal.SIZE
        if not np.isfinite(command.controls).all() or not np.isfinite(command.stamp):
            return Refusal.NAN
        times = np.zeros(1) if command.trajectory is None else command.trajectory[0]
        if not np.isfinite(times).all() or (np.diff(times) < 0.0).any():
            return Refusal.TIMES
        if (command.controls < self._lower).any() or (command.controls > self._upper).any():
            return Refusal.LIMITS
        overtaken = good is not None and command.sender == good.sender and command.stamp < good.stamp
        return Refusal.STALE if overtaken or abs(now - command.stamp) > COMMANDS_TIMEOUT else None

    def _age(self, command: Command, now: float) -> float:
        """Age of the last good command, whose time may be a little ahead."""
        return now - min(command.stamp, self.times.last)
