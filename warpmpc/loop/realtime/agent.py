# SPDX-License-Identifier: Apache-2.0
"""The agent: what the robot is sent at every tick, from the newest plan or from the watchdog."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .watchdog import Bounds, FaultKind, Finding, SafeCommands, Watchdog, received

if TYPE_CHECKING:
    from ...scene.model.layout import Layout
    from ...scene.model.state import State
    from ...scene.schema import Scene
    from ..log.run_log import RunLog
    from .messages import TimedPlan

logger = logging.getLogger("warpmpc")

CALM = 0.5
"""Time for which plans are followed before a fault counts as over [s]: one that hovers about its threshold is one."""


@dataclass
class Fault:
    """A time in which no plan was followed, or one again and again for short."""

    kind: FaultKind
    """Kind of what was wrong first."""
    why: str
    """A sentence about it."""
    start: float
    """Begin [s], on the robot's clock."""
    end: float | None = None
    """End [s], when plans were followed again; None while they are not."""
    count: int = 1
    """Number of times it came to that, with less than :data:`CALM` in between."""

    @classmethod
    def of(cls, log: RunLog) -> tuple[Fault, ...]:
        """Faults of a run log."""
        newest = {int(row.index): row for row in log.faults}
        return tuple(
            cls(
                FaultKind(row.kind),
                row.why,
                float(row.start),
                None if np.isnan(row.end) else float(row.end),
                int(row.count),
            )
            for row in newest.values()
        )

    @property
    def recovery(self) -> str:
        """A sentence about its end."""
        again = f", {self.count} times in all" if self.count > 1 else ""
        return f"following the plan again after {self.end - self.start:.3f} s{again}"


class Agent:
    """Evaluates the newest plan at the robot's clock, and sends the safe command where it cannot be trusted.

    The safe command is that of the drives: zero velocity, zero effort (or, with ``agent.safe = "gravity"``, what holds
    the robot where it was last seen), a stop, or the position where the robot was when the fault began. Limits of
    controls and ``agent.slew`` hold for whatever is sent.

    Args:
        scene: The scene.
        layout: State layout (``Controller.layout``).

    Raises:
        SceneError: If ``agent.slew`` has neither one value nor one per control, or gravity is to be balanced in a
            scene without efforts.
    """

    faults: list[Fault]
    """Faults, the newest last; waiting for the first plan is no fault."""

    def __init__(self, scene: Scene, layout: Layout):
        self.layout, self._dt, self._tick = layout, scene.timing.control_dt, 1.0 / scene.agent.rate
        self._watchdog, self._bounds = Watchdog(scene, layout), Bounds(scene, layout)
        self._safe_commands = SafeCommands(scene, layout)
        self.faults = []
        self.following = False
        """True if the last command came from a plan."""
        self._seen = True
        self._troubled = False  # whether the newest fault is not over for long enough

    @property
    def fault(self) -> Fault | None:
        """Fault that lasts."""
        return self.faults[-1] if self.faults and self.faults[-1].end is None else None

    @property
    def trusts_observation(self) -> bool:
        """Return whether the last observation could be trusted."""
        return self._seen

    def command(self, state: State, timed: TimedPlan | None, now: float) -> np.ndarray | None:
        """The control ``[nu]`` to send now; None while there is neither a plan nor a position to hold.

        Args:
            state: The newest observation, with its time; its arrays may change afterwards.
            timed: The newest plan, None before the first.
            now: The robot's clock [s].
        """
        state = received(state)
        found = self._watchdog.observation_fault(state, now)
        self._seen = found is None
        found = found or self._watchdog.plan_fault(timed, now)
        if found is None:
            control = timed.plan.at(now, state)
            found = self._watchdog.command_fault(control)
        if found is None:
            self._recover(now)
            return self._bounds(control)
        self._fail(found, now, waiting=timed is None and self._seen)
        return None if self._watchdog.state is None else self._bounds(self._safe(now))

    def stop(self) -> Iterator[np.ndarray]:
        """Safe commands ``[nu]``, one for each tick, until the one that may stay: a brake ends, ``agent.slew`` is kept.

        There are none where the robot was never seen.
        """
        state = self._watchdog.state
        if state is None:
            return
        last, before = self._bounds.clip(self._safe(np.inf)), None
        for tick in itertools.count():
            elapsed = tick * self._tick
            sent = self._bounds(self._safe(state.time + elapsed))
            yield sent
            if np.array_equal(sent, last) or (elapsed > self._dt and np.array_equal(sent, before)):
                return
            before = sent

    def _recover(self, now: float) -> None:
        self.following = True
        self._safe_commands.release()
        if not self._troubled:
            return
        last = self.faults[-1]
        if last.end is None:
            last.end = now
        elif now - last.end >= CALM:
            self._troubled = False
            logger.warning("t = %.3f s: %s", last.end, last.recovery)

    def _fail(self, found: Finding, now: float, *, waiting: bool) -> None:
        self.following = False
        if self.fault is not None:
            self.fault.start = min(self.fault.start, now)  # the clock may be set back
        if waiting or self.fault is not None:
            return
        if self._troubled:
            self.faults[-1].end = None
            self.faults[-1].count += 1
        else:
            self._troubled = True
            self.faults.append(Fault(*found, now))
            logger.warning("t = %.3f s: %s; sending the safe command", now, found[1])

    def _safe(self, now: float) -> np.ndarray:
        return self._safe_commands(self._watchdog.state, now)
