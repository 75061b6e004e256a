# SPDX-License-Identifier: Apache-2.0
"""The thread that owns controller and plant: takes changes, observes, plans, applies, publishes what is seen."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..controller.controller import Controller
from ..model.safe import safe_command
from ..run.choose_engine import with_samples
from ..run.episode import Episode, compile_shared
from ..scene.load import load_scene
from .fan import Fan
from .snapshot import Snapshot

if TYPE_CHECKING:
    from ..cost.term import UserTerm
    from ..model.state import State
    from ..planner.plan import Plan

logger = logging.getLogger("warpmpc")

PUBLISH = 0.05
"""Shortest wall time between two snapshots with rollouts [s]."""
SETTLE = 0.3
"""Wall time without another change of a key after which it is made: texts are typed letter by letter [s]."""
WAIT = 0.02
"""Longest sleep between two looks at what others want [s]."""


class Session(threading.Thread):
    """Runs controller and plant in lock step until it is stopped, at the goal and after the time-out, too.

    Everything that touches either happens in this thread. Other threads hand in changes, which are taken between two
    plans, and read :attr:`snapshot`. A change that cannot be made is told there and leaves everything as it was.

    Args:
        source: Scene and variant.
        overrides: ``KEY=VALUE`` texts.
        seed: Seed of the first episode.
        engine: Engine of the rollouts.
        device: Device of the rollouts.
        terms: Users' own cost terms.
        pace: Simulated seconds per second of wall time at most.

    Raises:
        SceneError: If the scene is wrong.
        ValueError: If engine or device is unknown.
    """

    def __init__(
        self,
        source: str,
        *,
        overrides: Sequence[str] = (),
        seed: int = 0,
        engine: str = "auto",
        device: str = "auto",
        terms: Sequence[UserTerm] = (),
        pace: float = 1.0,
    ):
        super().__init__(name="warpmpc live", daemon=True)
        self.source, self.overrides, self.seed, self.pace = source, tuple(overrides), seed, pace
        self.watched = True
        """Whether anybody looks: else nothing is prepared to be seen of rollouts."""
        self.paused, self.planning, self.controlling = False, True, True
        self.tuned: dict[str, float] = {}
        """Weights and scalars changed since the start, by name."""
        self.keys: dict[str, str] = {}
        """Keys of the scene changed since the start, ``planner.samples`` and so on, with TOML values."""
        self.waiting: dict[str, str] = {}
        """Keys about to be changed."""
        self._options = {"engine": engine, "device": device, "terms": tuple(terms)}
        self._changes: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._ending = threading.Event()
        self._steps_wanted, self._message, self.build, self.episode = 0, "", 0, 0
        self._settled = self._from = 0.0
        self._build(source, self.overrides, {}, seed)

    # ---- for other threads

    def do(self, change: Callable[[], None]) -> None:
        """Hand in a change; it is made between two plans, in this object's thread."""
        self._changes.put(change)

    def set_value(self, name: str, value: object) -> None:
        """Change a weight, scalar or pose of the task."""

        def change() -> None:
            self.controller.task[name] = value
            if np.ndim(value) == 0:
                self.tuned[name] = float(value)

        self.do(change)

    def set_key(self, key: str, value: str) -> None:
        """Change a key of the scene, a TOML value, once it has not been changed again for :data:`SETTLE`.

        Keys of the planner are those of the next plan, which goes on from the last one; others begin a new episode.
        """

        def change() -> None:
            self.waiting[key] = value
            self._settled = time.perf_counter() + SETTLE

        self.do(change)

    def pause(self, paused: bool = True) -> None:
        """Hold the plant, or let it go on."""
        self.do(lambda: setattr(self, "paused", paused))

    def plan_or_not(self, planning: bool) -> None:
        """Plan, or follow the last plan to its end and hold then."""
        self.do(lambda: setattr(self, "planning", planning))

    def control_or_not(self, controlling: bool) -> None:
        """Send what is planned, or the safe command of the drives; plans are made all the same."""
        self.do(lambda: setattr(self, "controlling", controlling))

    def single_step(self) -> None:
        """Make one step while paused."""
        self.do(lambda: setattr(self, "_steps_wanted", self._steps_wanted + 1))

    def reset(self, seed: int | None = None) -> None:
        """Start the episode again, or that of another seed; tuned values stay."""
        self.do(lambda: self._reset(seed))

    def switch(self, source: str) -> None:
        """Go on with another scene, as its file has it."""
        self.do(lambda: self._build(source, (), {}, self.seed))

    def grab(self, body: str, point: np.ndarray) -> None:
        """Take hold of a body at a point of the world ``[3]`` [m]."""
        self.do(lambda: self.plant.hand.grab(body, point))

    def pull(self, point: np.ndarray) -> None:
        """Pull what is held to a point of the world ``[3]`` [m]."""
        self.do(lambda: self.plant.hand.body is None or self.plant.hand.pull(point))

    def turn(self, rotation: np.ndarray) -> None:
        """Turn what is held by a rotation vector in the world ``[3]`` [rad] since the grab."""
        self.do(lambda: self.plant.hand.body is None or self.plant.hand.turn(rotation))

    def release(self) -> None:
        """Let go of what is held."""
        self.do(lambda: self.plant.hand.release())

    def stop(self) -> None:
        """End the thread after the step it is at."""
        self._ending.set()

    # ---- in this thread

    def run(self) -> None:
        """Take changes, step, keep the pace."""
        self._from = time.perf_counter()
        while not self._ending.is_set():
            self._take_changes()
            control_dt, now = self.plant.scene.timing.control_dt, time.perf_counter()
            held = self.plant.diverged or (self.paused and not self._steps_wanted)
            due = self._from + control_dt / self.pace
            if held or (now < due and not self._steps_wanted):
                if held:
                    self._from = now - control_dt / self.pace
                self._publish(rollouts=False)
                self._ending.wait(WAIT if held else min(WAIT, due - now))
                continue
            self._from = min(now, max(due, now - 0.1))
            self._steps_wanted = max(0, self._steps_wanted - 1)
            self._guarded(self._step)

    def _take_changes(self) -> None:
        while True:
            try:
                change = self._changes.get_nowait()
            except queue.Empty:
                break
            self._guarded(change)
        if self.waiting and time.perf_counter() >= self._settled:
            keys, self.waiting = self.waiting, {}
            self._guarded(lambda: self._set_keys(keys))

    def _guarded(self, work: Callable[[], None]) -> None:
        """Do something; what goes wrong is told on the page and must not end the loop."""
        try:
            work()
        except Exception as error:
            self._message = " ".join(str(error).split()) or type(error).__name__
            logger.warning("%s", self._message)
            if work == self._step:
                self.paused = True  # it would go wrong at every step
        else:
            if work != self._step:
                self._message = ""

    def _step(self) -> None:
        observation = self.plant.observe()
        if self.planning:
            self._plan = self.controller.plan(observation)
        self._control = self._command(observation)
        self.plant.apply(self._control)
        now = time.perf_counter()
        rollouts = self.watched and (now - self._published >= PUBLISH or self.paused)
        if rollouts:
            self._published = now
        self._publish(rollouts=rollouts)

    def _command(self, observation: State) -> np.ndarray:
        plan, layout = self._plan, self.plant.layout
        usable = plan is not None and not (self.planning and self.controller.info.fallback)
        ended = usable and not self.planning and observation.time > plan.times[-1]
        self._state = "the plan has ended" if ended else "running"
        if self.controlling and usable and not ended:
            return plan.at(observation.time)
        dt = self.plant.scene.timing.control_dt
        safe = safe_command(layout, observation.joint_q[None], observation.joint_qd[None], dt)[0]
        return np.clip(safe, layout.control_lower, layout.control_upper)

    # ---- what is changed

    def _build(self, source: str, overrides: Sequence[str], keys: dict[str, str], seed: int) -> None:
        """Another scene, seed or plant; what there was stays if it cannot be built."""
        scene = load_scene(source, overrides=[*overrides, *_texts(keys)])
        episode = Episode(scene, seed=seed, compiled=compile_shared(scene), **self._options)
        fan = Fan(episode.controller)
        if source != self.source:
            self.tuned = {}
        self.source, self.overrides, self.keys, self.seed = source, tuple(overrides), keys, seed
        self.scene, self.controller, self.plant, self._fan = episode.scene, episode.controller, episode.plant, fan
        self.build += 1
        self._begin()

    def _begin(self) -> None:
        """What is shown belongs to a new episode."""
        for name, value in self.tuned.items():
            self.controller.task[name] = value
        self.episode += 1
        self._control = np.zeros(self.plant.layout.nu, np.float32)
        self._plan: Plan | None = None
        self._steps_wanted, self._published, self._state = 0, 0.0, "running"
        self._publish(rollouts=False)

    def _reset(self, seed: int | None) -> None:
        if seed is not None and seed != self.seed:
            self._build(self.source, self.overrides, self.keys, seed)
            return
        self.plant.reset()
        self.controller.reset()
        self._begin()

    def _set_keys(self, changed: dict[str, str]) -> None:
        keys = {**self.keys, **changed}
        if all(key.startswith("planner.") for key in changed):
            self._replan(keys)
        else:
            self._build(self.source, self.overrides, keys, self.seed)

    def _replan(self, keys: dict[str, str]) -> None:
        """A controller of the same task with another planner, once it has made a plan."""
        planner = load_scene(self.source, overrides=[*self.overrides, *_texts(keys)]).planner
        old, scene = self.controller, self.scene.model_copy(update={"planner": planner})
        if not isinstance(planner.samples, int):
            scene = with_samples(scene, old.shape.samples)  # measured at the start
        controller = Controller(
            scene,
            engine=old.engine.name,
            device=old.device,
            seed=self.seed,
            terms=self._options["terms"],
            compiled=old.compiled,
            task=old.task,
        )
        controller.step(self.plant.observe())  # what users' functions make of it shows now
        controller.reset(self._plan)
        self.scene, self.controller, self.keys, self._fan = scene, controller, keys, Fan(controller)

    def _publish(self, *, rollouts: bool) -> None:
        plant, task = self.plant, self.controller.task
        info = self.controller.info if self.planning else None
        if info is None or info.fallback:
            self._fan.clear()
        elif rollouts:
            self._fan.look()
        forces = np.array(plant.forces).copy() if plant.pairs and plant.steps else np.zeros((len(plant.pairs), 3))
        state = "paused" if self.paused and not plant.diverged else plant.reason if plant.done else self._state
        nothing = float("nan")
        self.snapshot = Snapshot(
            source=self.source,
            build=self.build,
            episode=self.episode,
            time=plant.time,
            steps=plant.steps,
            body_q=np.array(plant.body_q).copy(),
            poses={name: task.pose(name).copy() for name in task.pose_name},
            values={name: float(task[name]) for name in (*task.weight_name, *task.scalar_name)},
            ways=self._fan.ways,
            forecast=self._fan.forecast,
            forces=forces,
            pull=plant.hand.spring,
            control=np.array(self._control),
            cost=nothing if info is None else info.cost,
            eta=nothing if info is None else info.eta,
            beta=nothing if info is None else info.beta,
            plan_ms=nothing if info is None else info.plan_ms,
            state=state,
            paused=self.paused,
            planning=self.planning,
            controlling=self.controlling,
            message=self._message,
        )


def _texts(keys: dict[str, str]) -> list[str]:
    return [f"{key}={value}" for key, value in keys.items()]
