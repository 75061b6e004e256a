# SPDX-License-Identifier: Apache-2.0
"""The thread that owns controller and plant: takes changes, observes, plans, applies, publishes what is seen."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..controller.controller import Controller
from ..model.safe import safe_command
from ..run.episode import Episode, compile_shared
from ..scene.load import load_scene
from .fan import Ways, ways_of

if TYPE_CHECKING:
    from ..cost.term import UserTerm

logger = logging.getLogger("warpmpc")

PUBLISH = 0.05
"""Shortest wall time between two snapshots with rollouts [s]."""


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """What there is to see after a step; arrays are copies."""

    episode: int
    """Counts resets: curves begin anew when it changes."""
    time: float
    """Simulated time [s]."""
    steps: int
    body_q: np.ndarray
    """Poses of the bodies ``[nb, 7]``."""
    poses: dict[str, np.ndarray]
    """Goal and movable obstacles ``[7]``."""
    ways: Ways | None
    """Best rollout and fan; None without a plan."""
    forces: np.ndarray
    """Net forces of the plant's pairs ``[pairs, 3]`` [N]."""
    control: np.ndarray
    terms: dict[str, float]
    plan_ms: float
    done: bool
    reason: str
    paused: bool
    message: str
    """What became of the last change that could not be made; empty when all is well."""


class Session(threading.Thread):
    """Runs controller and plant in lock step until it is stopped.

    Everything that touches either happens in this thread. Other threads hand in changes, which are taken between two
    plans, and read :attr:`snapshot`.

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
        self.source, self.overrides, self.pace = source, list(overrides), pace
        self.seed, self.paused, self.planning = seed, False, True
        self.tuned: dict[str, float] = {}
        """Weights and scalars changed since the start, by name."""
        self.planner_keys: dict[str, str] = {}
        """Planner's keys changed since the start, ``planner.samples`` and so on, with TOML values."""
        self._scene = load_scene(source, overrides=overrides)
        self._compiled = compile_shared(self._scene)
        self._options = {"engine": engine, "device": device, "terms": terms}
        self._changes: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._ending = threading.Event()
        self._steps_wanted, self._message, self.episode = 0, "", 0
        self._build()

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

    def set_planner(self, key: str, value: str) -> None:
        """Change a key of the planner, a TOML value; the next plan is made by a controller built anew."""
        self.do(lambda: self._rebuild(key, value))

    def pause(self, paused: bool = True) -> None:
        """Hold the plant, or let it go on."""
        self.do(lambda: setattr(self, "paused", paused))

    def plan_or_not(self, planning: bool) -> None:
        """Plan, or send the safe command of the drives."""
        self.do(lambda: setattr(self, "planning", planning))

    def single_step(self) -> None:
        """Make one step while paused."""
        self.do(lambda: setattr(self, "_steps_wanted", self._steps_wanted + 1))

    def reset(self, seed: int | None = None) -> None:
        """Start the episode again, or that of another seed; tuned values stay."""
        self.do(lambda: self._reset(seed))

    def stop(self) -> None:
        """End the thread after the step it is at."""
        self._ending.set()
        self.do(lambda: None)

    # ---- in this thread

    def run(self) -> None:
        """Take changes, step, keep the pace."""
        due = time.perf_counter()
        while not self._ending.is_set():
            self._take_changes()
            if self.plant.done or (self.paused and not self._steps_wanted):
                self._publish(rollouts=False)
                self._ending.wait(0.02)
                due = time.perf_counter()
                continue
            self._steps_wanted = max(0, self._steps_wanted - 1)
            self._step()
            due = max(due + self.plant.scene.timing.control_dt / self.pace, time.perf_counter() - 0.1)
            while (left := due - time.perf_counter()) > 0 and not self._ending.is_set():
                time.sleep(min(left, 0.02))

    def _take_changes(self) -> None:
        while True:
            try:
                change = self._changes.get_nowait()
            except queue.Empty:
                return
            try:
                change()
                self._message = ""
            except (ValueError, KeyError) as error:  # a change that cannot be made must not end the loop
                self._message = " ".join(str(error).split())
                logger.warning("%s", self._message)

    def _step(self) -> None:
        observation = self.plant.observe()
        if self.planning:
            self._control = self.controller.step(observation)
        else:
            layout, dt = self.plant.layout, self.plant.scene.timing.control_dt
            safe = safe_command(layout, observation.joint_q[None], observation.joint_qd[None], dt)[0]
            self._control = np.clip(safe, *self._limits)
        self.plant.apply(self._control)
        now = time.perf_counter()
        rollouts = now - self._published >= PUBLISH or self.paused
        if rollouts:
            self._published = now
        self._publish(rollouts=rollouts)

    def _build(self) -> None:
        episode = Episode(self._scene, seed=self.seed, compiled=self._compiled, **self._options)
        self.scene, self.controller, self.plant = episode.scene, episode.controller, episode.plant
        layout = self.plant.layout
        self._limits = (layout.control_lower, layout.control_upper)
        for key, value in list(self.planner_keys.items()):
            self._rebuild(key, value)
        self._begin()

    def _begin(self) -> None:
        """What is shown belongs to a new episode."""
        for name, value in self.tuned.items():
            self.controller.task[name] = value
        self.episode += 1
        self._control = np.zeros(self.plant.layout.nu, np.float32)
        self._ways, self._published = None, 0.0
        self._publish(rollouts=False)

    def _reset(self, seed: int | None) -> None:
        self._ways, self._steps_wanted = None, 0
        if seed is not None and seed != self.seed:
            self.seed = seed
            self._build()
            return
        self.plant.reset()
        self.controller.reset()
        self._begin()

    def _rebuild(self, key: str, value: str) -> None:
        """A controller of the same task with another planner; nothing changes if the scene refuses it."""
        keys = {"planner.samples": str(self.scene.planner.samples), **self.planner_keys, key: value}
        changed = load_scene(self.source, overrides=[*self.overrides, *(f"{k}={v}" for k, v in keys.items())])
        scene = self.scene.model_copy(update={"planner": changed.planner})
        old = self.controller
        self.controller = Controller(
            scene,
            engine=old.engine.name,
            device=old.device,
            seed=self.seed,
            terms=self._options["terms"],
            compiled=old.compiled,
            task=old.task,
        )
        self.scene, self._ways = scene, None
        self.planner_keys[key] = value

    def _publish(self, *, rollouts: bool) -> None:
        plant, task = self.plant, self.controller.task
        info = self.controller.info if self.planning else None
        if rollouts or info is None:
            self._ways = None if info is None or info.fallback else ways_of(self.controller)
        forces = np.array(plant.forces).copy() if plant.pairs and plant.steps else np.zeros((len(plant.pairs), 3))
        self.snapshot = Snapshot(
            episode=self.episode,
            time=plant.time,
            steps=plant.steps,
            body_q=np.array(plant.body_q).copy(),
            poses={name: task.pose(name).copy() for name in task.pose_name},
            ways=self._ways,
            forces=forces,
            control=np.array(self._control),
            terms={} if info is None else {**info.terms, "total": info.cost},
            plan_ms=float("nan") if info is None else info.plan_ms,
            done=plant.done,
            reason=plant.reason if plant.done else "",
            paused=self.paused,
            message=self._message,
        )
