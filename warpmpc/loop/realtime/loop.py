# SPDX-License-Identifier: Apache-2.0
"""The robot's loop: observe, tell the planner, send what the agent says, at a rate that no plan can disturb.

Signals that end a program, handled so that what has to be done last is done.
"""

from __future__ import annotations

import gc
import os
import signal
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from ...scene.errors import SceneError
from ...scene.model.compiled import compile_scene
from ...scene.schema import Refinement
from .agent import Agent, Fault
from .messages import TimedObservation, TimedPlan
from .pace import NewestNumbers, Pace, RobotClock, percentiles
from .watchdog import received

if TYPE_CHECKING:
    from types import FrameType

    from ...scene.model.state import State
    from ...scene.schema import Scene

NAMES = (
    "SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGALRM", "SIGVTALRM", "SIGPROF", "SIGUSR1", "SIGUSR2", "SIGXCPU",
    "SIGXFSZ", "SIGPOLL", "SIGPWR", "SIGSTKFLT", "SIGPIPE",
)  # fmt: skip
"""Signals that end a program and can be handled, where the system has them; real-time signals besides."""
STOPS = ("SIGTSTP", "SIGTTIN", "SIGTTOU")
"""Signals that stop a program and can be handled: Ctrl-Z, and the terminal of a program in the background."""


class Signals:
    """While a block runs, signals of :data:`NAMES` raise ``SystemExit`` unless something handles them.

    The first signal whose handler raises is the last one heard, so that nothing interrupts the ``finally`` clauses;
    :meth:`hold` does that for an end without a signal. What came too late then is heard after the block. Ignored
    signals stay ignored. Signals of :data:`STOPS` are noted: :meth:`suspend` stops the program. In other threads than
    the main one nothing is done: they hear no signals.
    """

    def __init__(self):
        self._held = False
        self._raised = False
        self._late: list[int] = []
        self._before: dict[int, object] = {}
        self.stopped = False
        """Whether a signal came that stops the program, and :meth:`suspend` was not called since."""

    def __enter__(self) -> Signals:
        if threading.current_thread() is threading.main_thread():
            for number in (*_numbers(NAMES), *range(signal.SIGRTMIN, signal.SIGRTMAX + 1)):
                self._handle(number, self._hear)
            for number in _numbers(STOPS):
                if signal.getsignal(number) is signal.SIG_DFL:
                    self._handle(number, self._note_stop)
        return self

    def __exit__(self, *error: object) -> None:
        for number, before in self._before.items():
            signal.signal(number, before)
        if self._late and not self._raised:
            self._end(self._late[0], None)

    def _handle(self, number: int, handler: Callable[[int, FrameType | None], None]) -> None:
        before = signal.getsignal(number)
        if callable(before) or before is signal.SIG_DFL:
            self._before[number] = before
            signal.signal(number, handler)

    def suspend(self) -> None:
        """Stop the program; returns once it is continued."""
        os.kill(os.getpid(), signal.SIGSTOP)
        self.stopped = False

    def _note_stop(self, number: int, frame: FrameType | None) -> None:
        self.stopped = True

    def hold(self) -> None:
        """Hear no more signals until the end of the block."""
        self._held = True

    def _hear(self, number: int, frame: FrameType | None) -> None:
        if self._held:
            self._late.append(number)
            return
        try:
            self._end(number, frame)
        except BaseException:
            self._held = self._raised = True
            raise

    def _end(self, number: int, frame: FrameType | None) -> None:
        """Handle the signal as without us, but for ending the program on the spot."""
        before = self._before[number]
        if not callable(before):
            raise SystemExit(128 + number)
        before(number, frame)


def _numbers(names: Sequence[str]) -> list[int]:
    """Numbers of the signals that the system has."""
    return [int(getattr(signal, name)) for name in names if hasattr(signal, name)]


class Robot(Protocol):
    """A robot, real or simulated, in two functions.

    Optional: ``follow(plan, now)`` in place of ``apply`` while a plan is followed, for drivers that send its next
    knots; ``stop()`` after the last safe command; ``tell(timed, now=, fault=)`` at every tick, for drivers that tell
    others of the planner. Where a robot is chosen by its name, there count besides:
    ``simulated``, true where it moves on by a tick with every command; ``use_sim_time``, true where its clock may run
    slower than this host's; ``done``, true where the driver ends the run; ``close()``; ``heard()``, the
    :class:`~warpmpc.loop.robots.sources.Heard` of each of its sources; ``measurements()``, the measurements
    (:mod:`warpmpc.loop.estimation.measurement`) since it was asked last, stamped by the robot's clock; ``measures``,
    their types, poses alone where left out; ``show_paths(source)``, for drivers that show what ``source()`` has of
    :class:`~warpmpc.planner.controller.rollout_paths.RolloutPaths`.
    """

    def observe(self) -> State | None:
        """The newest state, with its time, None before the first; returns at once.

        Its arrays are copied, so they may be used again. None later on is the last state once more, which grows old.
        """

    def apply(self, control: np.ndarray) -> None:
        """Send a control ``[nu]``, which is held until the next one; a simulated robot moves on by one tick.

        The array is the driver's own.
        """


class Planner(Protocol):
    """Source of plans: :class:`PlannerProcess` or :class:`PlannerThread`."""

    def observe(self, observation: TimedObservation) -> None:
        """Hand over an observation; returns at once."""

    def newest(self) -> TimedPlan | None:
        """The newest plan, None before the first; returns at once."""


class TickLogger(Protocol):
    """Takes note of every tick, such as :class:`warpmpc.RunRecorder`."""

    def tick(
        self,
        control: np.ndarray | None,
        timed: TimedPlan | None,
        *,
        seen: State,
        now: float,
        following: bool,
        late: float,
        faults: Sequence[Fault],
    ) -> None:
        """Take note of a tick; returns at once.

        Args:
            control: What was sent ``[nu]``, None where nothing was.
            timed: The newest plan, None before the first.
            seen: What was observed.
            now: The robot's clock [s].
            following: Whether the control came from the plan.
            late: How late the tick was, in wall time [s].
            faults: What went wrong so far, the newest last.
        """

    def close(self) -> None:
        """Write what is left."""


@dataclass(frozen=True, kw_only=True)
class RealTimeReport:
    """Rates, latencies and faults of a run in real time."""

    ticks: int
    """Commands sent."""
    rate: float
    """Ticks in a second of the robot's clock [Hz]."""
    jitter_ms: dict[str, float]
    """Lateness of ticks, in wall time [ms]: ``p50``, ``p99``, ``max``."""
    missed: int
    """Ticks whose work was not done when the next one was due."""
    slipped: float
    """Wall time that a simulated robot's clock waited because it was too far behind [s]."""
    plans: int
    """Plans received."""
    plan_rate: float
    """Plans in a second of wall time [Hz]."""
    latency_ms: dict[str, float]
    """From observation to plan on the robot's clock [ms]: ``p50``, ``p99``, ``max``; NaN without a plan."""
    plan_ms: dict[str, float]
    """Wall time of the planning itself [ms], likewise."""
    age_ms: dict[str, float]
    """Age of observations at ticks, on the robot's clock [ms], likewise: beyond the shortest way that they took."""
    faults: tuple[Fault, ...]
    """Times in which no plan was followed."""


class RobotLoop:
    """Runs a robot at ``agent.rate``.

    Args:
        scene: The scene.
        robot: The robot.
        planner: Where plans come from.
        speed: The robot's seconds in a second of wall time; below 1 a simulated robot is slowed down, and the planner
            is to know.
        simulated: Whether the robot moves on by one tick with every command and waits in between, as a simulated one
            does. A real one does not: then ticks that are long past are left out.
        agent: Evaluates plans; the scene's if None.
        recorder: Takes note of every tick.

    Raises:
        SceneError: If the driver sends plans and the scene has what they cannot keep: ``agent.slew`` or feedback.
    """

    def __init__(
        self,
        scene: Scene,
        robot: Robot,
        planner: Planner,
        *,
        speed: float = 1.0,
        simulated: bool = False,
        agent: Agent | None = None,
        recorder: TickLogger | None = None,
    ):
        self._recorder = recorder
        self.scene, self.robot, self.planner = scene, robot, planner
        self.agent = agent or Agent(scene, compile_scene(scene).layout)
        self.pace = Pace(1.0 / scene.agent.rate, speed=speed, skip=not simulated)
        self._clock = RobotClock(0.5 * scene.agent.observation_timeout)
        self._follow, self._tell = getattr(robot, "follow", None), getattr(robot, "tell", None)
        if self._follow is not None:
            _check_plans_alone(scene)
        self._last = np.zeros(len(self.agent.layout.control_name), dtype=np.float32)
        self._state: State | None = None
        self._number = -1
        self._latency_ms, self._plan_ms, self._age_ms = NewestNumbers(), NewestNumbers(), NewestNumbers()
        self.plans, self.ticks = 0, 0
        """Plans and ticks so far."""
        self.wall = 0.0
        """Wall time spent in :meth:`run` [s]."""

    @property
    def now(self) -> float:
        """The robot's clock at this tick [s]."""
        return self._clock.at(self.pace.now)

    def tick(self) -> np.ndarray | None:
        """Observe, tell the planner, command; returns the control ``[nu]`` that was sent, None where none was."""
        self.ticks += 1
        seen = self.robot.observe()
        if seen is not None:
            self._state = received(seen)
        if self._state is None:
            return None
        state = self._state
        self._clock.see(state.time, self.pace.now)
        timed = self.planner.newest()
        if timed is not None and timed.number != self._number:
            self._number = timed.number
            self.plans += 1
            self._latency_ms.append(1e3 * timed.latency)
            self._plan_ms.append(timed.plan_ms)
        now = self.now
        self._age_ms.append(1e3 * (now - state.time))
        control = self.agent.command(state, timed, now)
        if self.agent.trusts_observation:
            self.planner.observe(TimedObservation(state, self._last, self.agent.following))
        if control is not None:
            self._last = control
            if self.agent.following and self._follow is not None:
                self._follow(timed.plan, now)
            else:
                self.robot.apply(control.copy())
        if self._tell is not None:
            self._tell(timed, now=now, fault=self.agent.fault)
        if self._recorder is not None:
            late, following, faults = self.pace.late.last, self.agent.following, self.agent.faults
            self._recorder.tick(control, timed, seen=state, now=now, following=following, late=late, faults=faults)
        return control

    def run(self, until: Callable[[], bool]) -> RealTimeReport:
        """Tick until told to stop; whatever ends it, the last command is the safe one.

        In the main thread, which alone hears signals, that holds for every signal that can be handled. A signal that
        stops the program, as Ctrl-Z does, stops it after the safe command; it goes on when it is continued. The safe
        command takes more than a tick where ``agent.slew`` or a brake does.

        Args:
            until: Whether to stop, asked after every tick.

        Raises:
            SystemExit: On a signal that ends a program, where the program does not handle it itself.
        """
        if not self.ticks:  # a loop that goes on has no time for it
            gc.collect()
        gc.freeze()  # collecting what was built before takes longer than a tick
        start = time.monotonic()
        self.pace.start()
        with Signals() as signals:
            try:
                try:
                    self._tick_until(until, signals)
                finally:
                    signals.hold()
            finally:
                gc.unfreeze()
                self.wall += time.monotonic() - start
                self._stop()
        return self.report()

    def _tick_until(self, until: Callable[[], bool], signals: Signals) -> None:
        while True:
            self.tick()
            if until():
                return
            self.pace.wait()
            if signals.stopped:
                self._rest()
                signals.suspend()
                self.pace.start()

    def _stop(self) -> None:
        """Send the safe command, and end what the driver has."""
        self._rest()
        getattr(self.robot, "stop", lambda: None)()

    def _rest(self) -> None:
        """Send the safe command, at ticks until it is the one that may stay."""
        for count, safe in enumerate(self.agent.stop()):
            if count:
                self.pace.wait()
            self._last = safe
            self.robot.apply(safe.copy())

    def report(self) -> RealTimeReport:
        """Report on the run so far."""
        return RealTimeReport(
            ticks=self.ticks,
            rate=self.scene.agent.rate,
            jitter_ms=self.pace.jitter_ms(),
            missed=self.pace.missed,
            slipped=self.pace.slipped,
            plans=self.plans,
            plan_rate=self.plans / self.wall if self.wall else 0.0,
            latency_ms=percentiles(self._latency_ms.values()),
            plan_ms=percentiles(self._plan_ms.values()),
            age_ms=percentiles(self._age_ms.values()),
            faults=tuple(self.agent.faults),
        )


def _check_plans_alone(scene: Scene) -> None:
    """Refuse what the agent does to a plan's controls, where the driver sends the plan itself.

    Raises:
        SceneError: If the scene has a slew, or a planner with feedback.
    """
    refine, slew = scene.planner.refine, scene.agent.slew
    cure = "the driver sends plans: choose commands of single controls (such as std_msgs/Float64MultiArray), or"
    if slew is not None:
        message = f"does not hold for a trajectory; {cure} leave it out"
        raise SceneError(message, key="agent.slew", file=scene.path, found=list(slew))
    if refine is not None and refine.method is Refinement.ILQG:
        message = f"has feedback, which a trajectory loses; {cure} another method"
        raise SceneError(message, key="planner.refine.method", file=scene.path, found=refine.method.value)
