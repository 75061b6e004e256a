# SPDX-License-Identifier: Apache-2.0
"""The planning loop in a process of its own, which is started again whenever it dies or hangs."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import warp as wp

from ..compiling import native_output
from ..model.compiled import CompiledScene, compile_scene
from ..planner.feedback import StateSpace
from ..scene.errors import SceneError
from ..scene.schema import Refinement
from ..task.task import Task, task_layout
from .journal import FileJournal, read_journals
from .last_words import LastWords
from .letters import PlanCodec, Sighting, SightingCodec, TimedPlan
from .mailbox import Mailbox

if TYPE_CHECKING:
    from ctypes import c_ulong
    from multiprocessing.connection import Connection

    from ..cost.term import UserTerm
    from ..scene.schema import Scene
    from .real_time_log import RealTimeLog

logger = logging.getLogger("warpmpc")

SILENCE = 10.0
"""Wall time without a sign of life, beside that for which a plan is followed, after which a planner hangs [s]."""
LONGEST_START = 60.0
"""Wall time, or three times that of the first start, after which one that is started again hangs [s]."""
LOOK = 0.1
"""Wall time between looks for signs of life [s]."""
FIRST_PAUSE, LONGEST_PAUSE = 1.0, 30.0
"""Wall time before a planner that died young is started again [s]: it doubles from the first to the longest."""
GROWN_UP = 10.0
"""Wall time after which a planner did not die young [s]: another is started at once."""

MakeTerms = Callable[[], "Sequence[UserTerm]"]
"""Makes users' cost terms in the planner's process, such as ``functools.partial(warpmpc.load_terms, ["cost.py"])``."""


@dataclass(frozen=True)
class _Order:
    """What the process is to plan with."""

    scene: Scene
    seed: int
    engine: str
    device: str
    terms: MakeTerms | None
    speed: float
    knots: int
    journals: str | None
    """Folder for what is noted of plans."""


class PlannerProcess:
    """Plans in another process, so that the robot's loop never waits for a plan, nor for Python's lock.

    The processes share memory for observations, plans and signs of life, nothing else. One that dies is started again,
    for as long as this is open; why it died is logged. One that gives no sign of life is killed first: between two
    plans, and while it waits for observations, a planner gives one every 10 ms. Programs that use it have their entry
    below ``if __name__ == "__main__":``, as with all processes that are spawned.

        >>> with warpmpc.PlannerProcess(scene) as planner:
        ...     warpmpc.RobotLoop(scene, robot, planner).run(until=lambda: robot.done)

    Args:
        scene: The scene.
        seed: Seed of the controller.
        engine: Engine of the roll-outs, as for :class:`~warpmpc.Controller`.
        device: Device of the roll-outs, as for :class:`~warpmpc.Controller`.
        terms: Makes users' cost terms in that process.
        task: What the run wants: what is changed there takes effect at the next plan; one of its own if None.
        compiled: The scene compiled earlier, to save doing it again.
        speed: The robot's seconds in a second of wall time.
        log: Whether to keep what every plan was made from, for :attr:`log`. The planner notes it in a temporary file,
            which what becomes of the planner takes nothing from, and which costs the robot's loop nothing.

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
        log: bool = False,
    ):
        if scene.cloud:
            message = "point clouds do not travel between processes yet: run the scene without --real-time"
            raise SceneError(message, key="cloud", file=scene.path)
        self.scene, self.task = scene, task or Task(scene)
        self.compiled = compiled or compile_scene(scene)
        self.layout = task_layout(self.compiled.layout, scene)
        knots = max(scene.planner.knots or 0, scene.planner.horizon)
        self._folder = tempfile.TemporaryDirectory(prefix="warpmpc_plans_") if log else None
        journals = self._folder and self._folder.name
        self._log: RealTimeLog | None = None
        self._order = _Order(scene, seed, engine, device, terms, speed, knots, journals)
        self._context = multiprocessing.get_context("spawn")  # physics and its threads do not survive a fork
        self._sightings = SightingCodec(self.layout, self.task.block.shape[1])
        self._plans = PlanCodec(self.layout, scene.planner.spline, knots, _space(scene, self.compiled))
        self._seen = Mailbox(self._context, self._sightings.capacity)
        self._planned = Mailbox(self._context, self._plans.capacity)
        self._beats = self._context.RawValue("L")  # signs of life
        self._silence = SILENCE + scene.agent.plan_timeout / speed
        self._longest_start: float | None = None  # the first takes the time that it takes: it may compile
        self._timed: TimedPlan | None = None
        self._closed = threading.Event()
        self._starting = threading.Lock()  # nothing is started any more once it is closed

    def __enter__(self) -> PlannerProcess:
        """Start, and wait until it has planned once.

        Raises:
            SceneError: If the scene is wrong.
            ValueError: If the engine or device is unknown or not to be had here.
            RuntimeError: If the process died.
        """
        begin = time.monotonic()
        self._start()
        try:
            self._await()
        except BaseException:
            self._process.kill()
            if self._folder is not None:
                self._folder.cleanup()
            raise
        self._born = time.monotonic()
        self._longest_start = max(LONGEST_START, 3.0 * (self._born - begin))
        self._keeper = threading.Thread(target=self._keep, daemon=True)
        self._keeper.start()
        return self

    def __exit__(self, *error: object) -> None:
        with self._starting:
            self._closed.set()
            self._process.kill()
        self._keeper.join()
        if self._folder is not None:
            self._close_log()

    @property
    def log(self) -> RealTimeLog | None:
        """What the plans so far were made from, for :func:`warpmpc.replay_real_time`; None where it is not kept."""
        return self._log if self._folder is None else read_journals(Path(self._folder.name))

    @property
    def pid(self) -> int:
        """Process id of the planner, for a look at it."""
        return self._process.pid

    def observe(self, sighting: Sighting) -> None:
        """Hand over an observation, with the task as it is; the one before is forgotten."""
        self._seen.write(self._sightings.encode(replace(sighting, task=self.task.block[0])))

    def newest(self) -> TimedPlan | None:
        """The newest plan."""
        letter = self._planned.read()
        if letter is not None:
            self._timed = self._plans.decode(letter)
        return self._timed

    def _close_log(self) -> None:
        """Read what planners noted, and tell where something is missing; that the robot ran is worth more."""
        try:
            self._log = self.log
        except OSError as error:
            logger.error("what plans were made from cannot be read: %s", error)
        else:
            last = self._log.number[-1] if self._log is not None and len(self._log) else -1
            if self._timed is not None and last < self._timed.number:
                logger.error("of plans 0 to %d those after %d could not be logged", self._timed.number, last)
        self._folder.cleanup()
        self._folder = None

    def _start(self) -> None:
        self._ready, theirs = self._context.Pipe(duplex=False)
        self._words = LastWords(self._context)
        arguments = (self._order, self._seen, self._planned, self._beats, theirs, self._words.writer)
        self._process = self._context.Process(target=_plan, args=arguments, daemon=True)
        self._process.start()
        theirs.close()
        self._words.listen()

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
        """How the process ended, and what it wrote last."""
        return "\n  ".join([f"exit code {self._process.exitcode}", *self._words.lines()])

    def _keep(self) -> None:
        """Start the process again whenever it dies or hangs, after pauses that grow while it does so young."""
        pause, why = 0.0, None
        while True:
            hangs = self._outlive()
            if self._closed.is_set():
                return
            if time.monotonic() - self._born >= GROWN_UP:
                pause = 0.0
            when = f" in {pause:g} s" if pause else ""
            end = f"hung: no sign of life for {self._silence:g} s" if hangs else "died"
            logger.warning("the planner's process %s (%s); starting another%s", end, why or self._why(), when)
            if self._closed.wait(pause):
                return
            pause = min(max(FIRST_PAUSE, 2.0 * pause), LONGEST_PAUSE)
            with self._starting:
                if self._closed.is_set():
                    return
                self._start()
            why = self._does_not_start()

    def _outlive(self) -> bool:
        """Wait until the process is dead, and kill it when it hangs; whether it did."""
        beats, silent = None, 0  # looks, for a host that sleeps is silent, too
        while self._process.exitcode is None:
            self._process.join(LOOK)
            silent = silent + 1 if self._beats.value == beats else 0
            beats = self._beats.value
            if silent * LOOK > self._silence:
                self._process.kill()
                self._process.join()
                return True
        return False

    def _does_not_start(self) -> str | None:
        """Wait until the process plans; what kept it from that, None for nothing."""
        try:
            self._await()
            return None
        except Exception as error:
            return f"it does not start: {error}"
        finally:
            self._born = time.monotonic()


def _plan(order: _Order, seen: Mailbox, planned: Mailbox, beats: c_ulong, ready: Connection, words: Connection) -> None:
    """What the process does: its parent alone hears it, it leaves Ctrl-C to its parent and does not outlive it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.dup2(words.fileno(), 2)
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)  # libraries chat on standard output, from native code, too
    logger.setLevel(logging.ERROR)  # what plans come to, the agent says
    parent = multiprocessing.parent_process()
    try:
        with native_output():  # Warp complains about a missing GPU
            wp.config.log_level = wp.LOG_WARNING
            wp.init()
        from ..controller.controller import Controller
        from .planning import Planning

        terms = order.terms() if order.terms else ()
        scene = order.scene
        controller = Controller(scene, engine=order.engine, device=order.device, seed=order.seed, terms=terms)
        task = controller.task.block.shape[1]
        sightings = SightingCodec(controller.layout, task)
        plans = PlanCodec(controller.layout, scene.planner.spline, order.knots, _space(scene, controller.compiled))
        journal = None if order.journals is None else FileJournal(controller, Path(order.journals))
        planning = Planning(controller, speed=order.speed, number=planned.sent, journal=journal)
        ready.send(None)
    except Exception as error:
        ready.send(error)
        return

    def newest() -> Sighting | None:
        letter = seen.read()
        return None if letter is None else sightings.decode(letter)

    def publish(timed: TimedPlan) -> None:
        planned.write(plans.encode(timed))

    def stopped() -> bool:
        beats.value += 1
        return not parent.is_alive()

    planning.run(newest, publish, stopped)


def _space(scene: Scene, compiled: CompiledScene) -> StateSpace | None:
    """How states are subtracted where a scene's plans have feedback."""
    refine = scene.planner.refine
    return StateSpace.of(compiled) if refine and refine.method is Refinement.ILQG else None
