# SPDX-License-Identifier: Apache-2.0
"""The planning loop in a separate process, which is started again whenever it dies or hangs."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import warp as wp

from ...physics.runtime.compiling import native_output
from ...planner.controller.rollout_paths import RolloutPaths, acting_frames, see_rollouts
from ...planner.feedback import StateSpace
from ...planner.refine import refined
from ...planner.refiners import most_knots
from ...scene.errors import SceneError
from ...scene.model.compiled import CompiledScene, compile_scene
from ...scene.schema import Refinement
from ...scene.task.task import Task, task_layout
from ..log.run_log import planner_files, read_planners
from .messages import LatestValue, ObservationCodec, PathsCodec, PlanCodec, StderrTail, TimedObservation, TimedPlan
from .plan_logger import PlanLogger

if TYPE_CHECKING:
    from ctypes import c_byte, c_ulong
    from multiprocessing.connection import Connection

    from ...cost.term import UserTerm
    from ...scene.schema import Scene

logger = logging.getLogger("warpmpc")

HEARTBEAT_TIMEOUT = 10.0
"""Wall time without a heartbeat, beside that for which a plan is followed, after which a planner hangs [s]."""
LONGEST_START = 60.0
"""Wall time, or three times that of the first start, after which one that is started again hangs [s]."""
POLL_PERIOD = 0.1
"""Wall time between two looks at the heartbeat [s]."""
FIRST_BACKOFF, LONGEST_BACKOFF = 1.0, 30.0
"""Wall time before a planner that ended early is started again [s]: it doubles from the first to the longest."""
STABLE_AFTER = 10.0
"""Wall time after which the end of a planner is not early [s]: another is started at once."""

MakeTerms = Callable[[], "Sequence[UserTerm]"]
"""Makes users' cost terms in the planner's process, such as ``functools.partial(warpmpc.load_terms, ["cost.py"])``."""


@dataclass(frozen=True)
class _Order:
    """Everything that the process plans with."""

    scene: Scene
    seed: int
    engine: str
    device: str
    terms: MakeTerms | None
    speed: float
    knots: int
    log: Path | None
    """Run log beside which plans are noted."""
    life: int = 0
    """Planners before this one."""


@dataclass(frozen=True)
class ShownPaths:
    """Paths of rollouts on their way to what asked for them."""

    value: LatestValue
    """The newest."""
    wanted: c_byte
    """True while paths are asked for."""


class PlannerProcess:
    """Plans in another process, so that the robot's loop never waits for a plan, nor for Python's lock.

    The processes share memory for observations, plans and heartbeats, nothing else. One that dies is started again,
    for as long as this is open; why it died is logged. One without a heartbeat is killed first: between two plans, and
    while it waits for observations, a planner gives one every 10 ms. Programs that use it have their entry
    below ``if __name__ == "__main__":``, as with all processes that are spawned.

        >>> with warpmpc.PlannerProcess(scene) as planner:
        ...     warpmpc.RobotLoop(scene, robot, planner).run(until=lambda: robot.done)

    Args:
        scene: The scene.
        seed: Seed of the controller.
        engine: Engine of the roll-outs, as for :class:`~warpmpc.Controller`.
        device: Device of the roll-outs, as for :class:`~warpmpc.Controller`.
        terms: Makes users' cost terms in that process.
        task: What the run wants: what is changed there takes effect at the next plan; a new one if None.
        compiled: The scene compiled earlier, to save doing it again.
        speed: The robot's seconds in a second of wall time.
        log: Run log beside which each planner notes what its plans are made from, in a file ``LOG.0``, ``LOG.1`` and so
            on, for :func:`warpmpc.replay`; earlier ones are removed. The end of a planner takes nothing from it, and
            it costs the robot's loop nothing. Nowhere if None.

    Raises:
        SceneError: If the scene has point clouds: they do not travel between processes yet.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        seed: int = 0,
        engine: str = "auto",
        device: str = "auto",
        terms: MakeTerms | None = None,
        task: Task | None = None,
        compiled: CompiledScene | None = None,
        speed: float = 1.0,
        log: str | Path | None = None,
    ):
        if scene.cloud:
            message = "point clouds do not travel between processes yet: run the scene without --real-time"
            raise SceneError(message, key="cloud", file=scene.path)
        self.scene, self.task = scene, task or Task(scene)
        self.compiled = compiled or compile_scene(scene)
        self.layout = task_layout(self.compiled.layout, scene)
        knots = most_knots(scene)
        log = None if log is None else Path(log)
        self._order = _Order(scene, seed, engine, device, terms, speed, knots, log)
        self._context = multiprocessing.get_context("spawn")  # physics and its threads do not survive a fork
        self._observations = ObservationCodec(self.layout, self.task.block.shape[1])
        self._plans = PlanCodec(self.layout, knots, _space(scene, self.compiled))
        self._observed = LatestValue(self._context, self._observations.capacity)
        self._planned = LatestValue(self._context, self._plans.capacity)
        self._beats = self._context.RawValue("L")  # heartbeats
        frames = acting_frames(scene, self.compiled.layout)
        self._paths = PathsCodec(len(frames[0]), scene.planner.horizon)
        self._shown = ShownPaths(LatestValue(self._context, self._paths.capacity), self._context.RawValue("b"))
        self._heartbeat_timeout = HEARTBEAT_TIMEOUT + scene.agent.plan_timeout / speed
        self._longest_start: float | None = None  # the first takes the time that it takes: it may compile
        self._timed: TimedPlan | None = None
        self._closed = threading.Event()
        self._starting = threading.Lock()  # nothing is started any more once it is closed

    def __enter__(self) -> PlannerProcess:
        """Start, and wait until it has planned once.

        Raises:
            SceneError: If the scene is wrong.
            ValueError: If the engine or device is unknown or not available here.
            RuntimeError: If the process died.
        """
        begin = time.monotonic()
        for old in planner_files(self._order.log) if self._order.log else ():
            if old.is_file():
                old.unlink()
        self._start()
        try:
            self._await()
        except BaseException:
            self._process.kill()
            raise
        self._started = time.monotonic()
        self._longest_start = max(LONGEST_START, 3.0 * (self._started - begin))
        self._supervisor = threading.Thread(target=self._supervise, daemon=True)
        self._supervisor.start()
        return self

    def __exit__(self, *error: object) -> None:
        with self._starting:
            self._closed.set()
            self._process.kill()
        self._supervisor.join()
        if self._order.log is not None:
            self._check_log()

    @property
    def pid(self) -> int:
        """Process id of the planner, for a look at it."""
        return self._process.pid

    def observe(self, observation: TimedObservation) -> None:
        """Hand over an observation, with the task as it is; the one before is forgotten."""
        self._observed.write(self._observations.encode(replace(observation, task=self.task.block[0])))

    def newest(self) -> TimedPlan | None:
        """The newest plan."""
        message = self._planned.read()
        if message is not None:
            self._timed = self._plans.decode(message)
        return self._timed

    def paths(self) -> RolloutPaths | None:
        """Paths of rollouts, those of one of the plans since the last call; None where there are none yet.

        A planner that was asked records the rollouts of its next plan, after it has sent that.
        """
        self._shown.wanted.value = True
        message = self._shown.value.read()
        return None if message is None else self._paths.decode(message)

    def _check_log(self) -> None:
        """Tell where notes of plans are missing; that the robot ran is worth more."""
        try:
            found = read_planners(self._order.log)
            last = found.plans.number[-1] if found is not None and len(found.plans) else -1
            if self._timed is not None and last < self._timed.number:
                logger.error("of plans 0 to %d those after %d could not be logged", self._timed.number, last)
        except (OSError, ValueError) as error:
            logger.error("what plans were made from cannot be read: %s", error)

    def _start(self) -> None:
        self._ready, theirs = self._context.Pipe(duplex=False)
        self._stderr = StderrTail(self._context)
        order, self._order = self._order, replace(self._order, life=self._order.life + 1)
        arguments = (order, self._observed, self._planned, self._shown, self._beats, theirs, self._stderr.writer)
        self._process = self._context.Process(target=_plan, args=arguments, daemon=True)
        self._process.start()
        theirs.close()
        self._stderr.listen()

    def _await(self) -> None:
        """Wait until the process plans, or raise what kept it from that."""
        try:
            if not self._ready.poll(self._longest_start):
                self._process.kill()
                raise TimeoutError(f"no plan after {self._longest_start:g} s")
            failed = self._ready.recv()
        except EOFError:
            self._process.join()
            raise RuntimeError(f"the planner's process died before its first plan ({self._why()})") from None
        if failed is not None:
            raise failed

    def _why(self) -> str:
        """Return how the process ended, and what it wrote last."""
        return "\n  ".join([f"exit code {self._process.exitcode}", *self._stderr.lines()])

    def _supervise(self) -> None:
        """Start the process again whenever it dies or hangs, with a backoff that grows while that comes early."""
        backoff, why = 0.0, None
        while True:
            hangs = self._await_end()
            if self._closed.is_set():
                return
            if time.monotonic() - self._started >= STABLE_AFTER:
                backoff = 0.0
            when = f" in {backoff:g} s" if backoff else ""
            end = f"hung: no heartbeat for {self._heartbeat_timeout:g} s" if hangs else "died"
            logger.warning("the planner's process %s (%s); starting another%s", end, why or self._why(), when)
            if self._closed.wait(backoff):
                return
            backoff = min(max(FIRST_BACKOFF, 2.0 * backoff), LONGEST_BACKOFF)
            with self._starting:
                if self._closed.is_set():
                    return
                self._start()
            why = self._await_start()

    def _await_end(self) -> bool:
        """Wait until the process is dead, and kill it when it hangs; return whether it did."""
        beats, missed = None, 0  # polls, for a host that sleeps misses them, too
        while self._process.exitcode is None:
            self._process.join(POLL_PERIOD)
            missed = missed + 1 if self._beats.value == beats else 0
            beats = self._beats.value
            if missed * POLL_PERIOD > self._heartbeat_timeout:
                self._process.kill()
                self._process.join()
                return True
        return False

    def _await_start(self) -> str | None:
        """Wait until the process plans; what kept it from that, None for nothing."""
        try:
            self._await()
            return None
        except Exception as error:
            return f"it does not start: {error}"
        finally:
            self._started = time.monotonic()


def _plan(
    order: _Order,
    observed: LatestValue,
    planned: LatestValue,
    shown: ShownPaths,
    beats: c_ulong,
    ready: Connection,
    stderr: Connection,
) -> None:
    """Plan in the process: its parent alone hears it, it leaves Ctrl-C to its parent and does not outlive it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.dup2(stderr.fileno(), 2)
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)  # libraries chat on standard output, from native code, too
    logger.setLevel(logging.ERROR)  # what plans come to, the agent says
    _give_way()
    parent = multiprocessing.parent_process()
    try:
        with native_output():  # Warp complains about a missing GPU
            wp.config.log_level = wp.LOG_WARNING
            wp.init()
        from ...planner.controller.controller import Controller
        from .planning import Planning

        terms = order.terms() if order.terms else ()
        scene = order.scene
        controller = Controller(scene, engine=order.engine, device=order.device, seed=order.seed, terms=terms)
        task = controller.task.block.shape[1]
        observations = ObservationCodec(controller.layout, task)
        plans = PlanCodec(controller.layout, order.knots, _space(scene, controller.compiled))
        frames = acting_frames(scene, controller.layout)
        paths = PathsCodec(len(frames[0]), scene.planner.horizon)
        notes = None if order.log is None else PlanLogger(controller, order.log, order.life)
        planning = Planning(controller, speed=order.speed, number=planned.sent, logger=notes)
        ready.send(None)
    except Exception as error:
        ready.send(error)
        return

    def newest() -> TimedObservation | None:
        message = observed.read()
        return None if message is None else observations.decode(message)

    def publish(timed: TimedPlan) -> None:
        planned.write(plans.encode(timed))
        if shown.wanted.value and (found := see_rollouts(controller, frames, paths.fan)) is not None:
            shown.wanted.value = False
            shown.value.write(paths.encode(found[1]))

    def stopped() -> bool:
        beats.value += 1
        return not parent.is_alive()

    planning.run(newest, publish, stopped)


def _give_way() -> None:
    """Let the robot's loop go first where it has a real-time priority, which processes that it starts inherit."""
    policy, priority = os.sched_getscheduler(0), os.sched_getparam(0).sched_priority
    if policy in (os.SCHED_FIFO, os.SCHED_RR) and priority > 1:
        os.sched_setscheduler(0, policy, os.sched_param(priority - 1))


def _space(scene: Scene, compiled: CompiledScene) -> StateSpace | None:
    """Subtraction of states where a scene's plans may have feedback."""
    return StateSpace.of(compiled) if refined(scene) in (Refinement.AUTO, Refinement.ILQG) else None
