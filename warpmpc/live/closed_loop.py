# SPDX-License-Identifier: Apache-2.0
"""Controller and plant of the page, step by step, and what may be changed about them in between."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..controller.controller import Controller
from ..model.safe import safe_command
from ..record.switch import RecordingSwitch
from ..run.choose_engine import with_samples
from ..run.episode import Episode, compile_shared
from ..scene.load import load_scene
from .foresight import Foreseen, ForesightMeter
from .rollouts import ShownRollouts
from .snapshot import Snapshot

if TYPE_CHECKING:
    from ..cost.term import UserTerm
    from ..model.state import State
    from ..planner.plan import Plan

PUBLISH = 0.05
"""Shortest wall time between two snapshots with rollouts [s]."""
COMPARE = 0.3
"""Shortest wall time between two comparisons of what was foreseen with what came [s]."""


class ClosedLoop:
    """Plans and applies one control after the other, and publishes what is seen; for one thread.

    What cannot be built or planned with raises and leaves everything as it was.

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
    ):
        self.source, self.overrides, self.seed = source, tuple(overrides), seed
        self.watched = True
        """Whether anybody looks: else nothing is prepared to be seen of rollouts."""
        self.paused, self.planning, self.controlling = False, True, True
        self.tuned: dict[str, float] = {}
        """Weights and scalars changed since the start, by name."""
        self.keys: dict[str, str] = {}
        """Keys of the scene changed since the start, ``planner.samples`` and so on, with TOML values."""
        self.message = ""
        """What became of the last change that could not be made; empty when all is well."""
        self._options = {"engine": engine, "device": device, "terms": tuple(terms)}
        self.build = self.episode = 0
        self._recording = RecordingSwitch()
        self._build(source, self.overrides, {}, seed)

    def _step(self) -> None:
        observation = self.plant.observe()
        if self.planning:
            self._plan = self.controller.plan(observation)
        self._control = self._command(observation)
        if self.planning:
            self.foresight.note(self._control)
        else:
            self.foresight.forget()
        self.plant.apply(self._control)
        if self.controller.info is not None:
            self._recording.log(self._control)
        now = time.perf_counter()
        rollouts = self.watched and (now - self._published >= PUBLISH or self.paused)
        if rollouts:
            self._published = now
            if now - self._compared >= COMPARE:
                self._foreseen, self._compared = self.foresight.compare() or self._foreseen, now
        self._publish(rollouts=rollouts)

    def _command(self, observation: State) -> np.ndarray:
        plan, layout = self._plan, self.plant.layout
        usable = plan is not None and not (self.planning and self.controller.info.fallback)
        ended = usable and not self.planning and observation.time > plan.times[-1]
        self._status = "the plan has ended" if ended else "running"
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
        shown = ShownRollouts(episode.controller), ForesightMeter(episode.controller, episode.plant)
        if source != self.source:
            self.tuned = {}
        self.source, self.overrides, self.keys, self.seed = source, tuple(overrides), keys, seed
        self.scene, self.controller, self.plant = episode.scene, episode.controller, episode.plant
        self._rollouts, self.foresight = shown
        self.build += 1
        self._begin()

    def _start_recording(self) -> None:
        self._recording.stop()
        names = (f"{self.scene.name}{n or ''}.rrd" for n in [0, *range(2, 10000)])
        file = next(file for file in map(Path.cwd().joinpath, names) if not file.exists())
        self._recording.start(file, self.controller, self.plant)

    def _begin(self) -> None:
        """Begin a new episode: what is shown belongs to it."""
        self._recording.stop()
        for name, value in self.tuned.items():
            self.controller.task[name] = value
        self.episode += 1
        self._control = np.zeros(self.plant.layout.nu, np.float32)
        self._plan: Plan | None = None
        self.foresight.clear()
        self._foreseen: Foreseen | None = None
        self._published, self._compared, self._status = 0.0, 0.0, "running"
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
        shown = ShownRollouts(controller), ForesightMeter(controller, self.plant)
        self._recording.stop()
        self.scene, self.controller, self.keys = scene, controller, keys
        self._rollouts, self.foresight, self._foreseen = *shown, None

    def _publish(self, *, rollouts: bool) -> None:
        plant, task = self.plant, self.controller.task
        info = self.controller.info if self.planning else None
        if info is None or info.fallback:
            self._rollouts.clear()
        elif rollouts:
            self._rollouts.update()
        forces = np.array(plant.forces).copy() if plant.pairs and plant.steps else np.zeros((len(plant.pairs), 3))
        status = "paused" if self.paused and not plant.diverged else plant.reason if plant.done else self._status
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
            paths=self._rollouts.paths,
            forecast=self._rollouts.forecast,
            forces=forces,
            pull=plant.perturbation.spring,
            control=np.array(self._control),
            cost=nothing if info is None else info.cost,
            eta=nothing if info is None else info.eta,
            beta=nothing if info is None else info.beta,
            plan_ms=nothing if info is None else info.plan_ms,
            foreseen=self._foreseen,
            status=status,
            paused=self.paused,
            planning=self.planning,
            controlling=self.controlling,
            recording=str(self._recording.path or ""),
            message=self.message,
        )


def _texts(keys: dict[str, str]) -> list[str]:
    return [f"{key}={value}" for key, value in keys.items()]
