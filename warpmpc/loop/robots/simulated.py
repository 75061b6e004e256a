# SPDX-License-Identifier: Apache-2.0
"""The simulated plant that takes commands at the agent's rate.

The simulated robot as a separate process: it moves in real time, publishes its state and hears commands.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from ...scene.draw import draw_task
from ...scene.model.compiled import CompiledScene, compile_scene
from ...scene.task.task import Task, task_layout
from ..estimation.measurement import ImuMeasured, PoseMeasured
from ..plant.plant import Plant
from ..plant.sensors import require_sensors
from ..plant.worlds import SUBSTEPS
from ..realtime.pace import Pace, percentiles
from .safety import Command, Refusal, Safety

if TYPE_CHECKING:
    from ...cost.term import UserTerm
    from ...scene.model.state import State
    from ...scene.schema import Scene
    from ..estimation.measurement import Measurement


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
        task: What the run wants, shared with the planner (``planner.task``); a new one if None.
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


STILL = 0.05
"""Time between measurements of a robot that has not been commanded yet [s]."""


class Transport(Protocol):
    """Carries states and commands between a robot and the program that commands it; every call returns at once."""

    measures: tuple[type, ...]
    """Kinds of measurements that it sends."""

    def publish(self, state: State) -> None:
        """Send what the robot measures; the stamp is ``state.time``."""

    def tell(self, measurements: Sequence[Measurement]) -> None:
        """Send measurements of sensors with their own rates, of times on the clock of states."""

    def receive(self, now: float) -> Iterable[Command]:
        """Commands that came since the last call, in their order; ``now`` [s] is the robot's clock."""

    def close(self) -> None:
        """Send and hear nothing any more."""


@dataclass(frozen=True, kw_only=True)
class RobotReport:
    """Commands that a robot was given, and how its run ended."""

    time: float
    """The robot's clock at the end [s]."""
    success: bool
    """True if its true state was a success at some time."""
    reason: str
    """A few words about how the run ended."""
    received: int
    """Commands that came."""
    refused: dict[str, int]
    """Those that were refused, by reason."""
    safe_state: float
    """Longest time from the last good command to the safe one [s]; NaN where that never came."""
    period_ms: dict[str, float]
    """Time between good commands on the robot's clock [ms]: ``p50``, ``p99``, ``max``."""
    age_ms: dict[str, float]
    """Age of the observation that a good command answers [ms], likewise: both ways and what is between."""
    jitter_ms: dict[str, float]
    """Lateness of the robot's own ticks, in wall time [ms], likewise."""
    slipped: float
    """Wall time that the robot's clock waited because it was too far behind [s]."""

    def to_json(self) -> dict[str, Any]:
        """The report as data for JSON: plain types, units in the keys."""
        return {
            "success": self.success,
            "reason": self.reason,
            "time_s": self.time,
            "received": self.received,
            "refused": self.refused,
            "safe_state_s": _number(self.safe_state),
            "period_ms": _numbers(self.period_ms),
            "age_ms": _numbers(self.age_ms),
            "jitter_ms": _numbers(self.jitter_ms),
            "slipped_s": self.slipped,
        }


class RobotProcess:
    """The scene's plant in real time behind a transport, with :class:`Safety` of its own.

    It stays at its start until the first good command, with a clock that goes on.

    Args:
        scene: The scene; what its ``randomize_task`` names is drawn from the seed.
        connect: Makes the transport from the state layout.
        seed: Seed of the task, and of the plant's properties and noise.
        speed: The robot's seconds in a second of wall time.
        terms: Users' own cost terms that success, failures or phases name.

    Raises:
        SceneError: As :class:`~warpmpc.Plant`.
        ValueError: If the transport cannot be made.
    """

    def __init__(
        self,
        scene: Scene,
        connect: Callable[..., Transport],
        *,
        seed: int = 0,
        speed: float = 1.0,
        terms: Sequence[UserTerm] = (),
    ):
        require_sensors(scene)
        scene = draw_task(scene, seed)[0]
        compiled = compile_scene(scene)
        layout = task_layout(compiled.layout, scene)
        self.transport = connect(layout)
        kinds = {"estimate": PoseMeasured, "estimate_base": ImuMeasured}
        elsewhere = {key: {} for key, kind in kinds.items() if kind in self.transport.measures}
        scene = scene.model_copy(update=elsewhere)  # the program that commands it estimates
        try:
            self.plant = simulated_robot(scene, seed=seed, task=Task(scene), terms=terms, compiled=compiled)
        except BaseException:
            self.transport.close()
            raise
        self.safety = Safety(scene, layout)
        self.pace = Pace(1.0 / scene.agent.rate, speed=speed, skip=False)
        self.control: np.ndarray | None = None
        """What the drives were given last ``[nu]``; None before the first good command."""
        self._began: float | None = None  # when the first good command came
        self._measured = -np.inf  # when sensors measured while it stood still
        self._success = False

    @property
    def now(self) -> float:
        """The robot's clock [s]."""
        return self.pace.now

    def tick(self) -> None:
        """Publish what is measured, hear commands, move on."""
        plant, now = self.plant, self.now
        seen = plant.observe()
        start = now if self._began is None else self._began
        measured = [replace(m, time=start + m.time) for m in plant.measured]
        if self._began is None and now >= self._measured + STILL:
            self._measured, measured = now, plant.measure(now)
        if measured:
            self.transport.tell(measured)
        self.transport.publish(replace(seen, time=start + seen.time))
        self.safety.take(list(self.transport.receive(now)), now)
        if self._began is None and self.safety.commanded:
            self._began = now
            self.transport.tell(plant.measure(now))  # units show means, which are not to reach back to where it stood
        if self._began is None:
            return
        self.control = self.safety.command(replace(plant.state, time=now), now)
        plant.apply(self.control)
        self._success |= plant.success

    def run(self, until: Callable[[], bool]) -> RobotReport:
        """Tick until told to stop, and report; the transport is closed.

        Args:
            until: Whether to stop, asked after every tick.
        """
        self.pace.start()
        try:
            while not self.plant.diverged:
                self.tick()
                if until():
                    break
                self.pace.wait()
        finally:
            self.transport.close()
        return self.report()

    def report(self) -> RobotReport:
        """Report on the run so far."""
        safety = self.safety
        why = self.plant.reason if self._began is not None else "never commanded"
        return RobotReport(
            time=self.now,
            success=self._success,
            reason="goal reached" if self._success else why,
            received=safety.received,
            refused={kind.value: safety.refused[kind] for kind in Refusal},
            safe_state=safety.safe_state,
            period_ms=percentiles(1e3 * np.diff(safety.times.values())),
            age_ms=percentiles(1e3 * safety.ages.values()),
            jitter_ms=self.pace.jitter_ms(),
            slipped=self.pace.slipped,
        )


def _numbers(values: dict[str, float]) -> dict[str, float | None]:
    return {name: _number(value) for name, value in values.items()}


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
