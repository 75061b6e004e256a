# SPDX-License-Identifier: Apache-2.0
"""Controller and plant of the page, step by step, and what may be changed about them in between."""

from __future__ import annotations

import logging
import re
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ...loop.realtime.messages import TimedObservation, TimedPlan
from ...loop.realtime.planning import PlannerThread
from ...loop.run.episode import Episode, compile_shared
from ...loop.run.fit_samples import with_samples
from ...physics.runtime.compiling import Later, quick
from ...planner.controller.controller import Controller
from ...scene.errors import join_key
from ...scene.load import load_scene
from ...scene.model.control_values import safe_command
from ...scene.schema import SampleCount
from ..record.switch import RecordingSwitch
from .foresight import Foreseen, ForesightMeter, ShownRollouts
from .snapshot import PlanCounter, Snapshot

if TYPE_CHECKING:
    from ...cost.term import UserTerm
    from ...planner.plan import Plan
    from ...scene.model.state import State
    from ...scene.schema import Scene

logger = logging.getLogger("warpmpc")

PUBLISH = 0.05
"""Shortest wall time between two snapshots with rollouts [s]."""
COMPARE = 0.3
"""Shortest wall time between two comparisons of what was foreseen with what came [s]."""
FIRST_PLAN = 30.0
"""Longest wait for the first plan from an observation [s]."""
COUNTED = 20
"""Newest controls over which plans are counted."""
_PLANNED = re.compile(r"planner\.|cost\..+\.norm\.")
"""Keys that another controller of the same task takes."""


def norm_values(scene: Scene) -> dict[str, float]:
    """Parameters of the norms of a scene's cost terms, by key: ``cost.head.norm.p``."""
    norms = {label: cost.params.get("norm") for label, cost in zip(scene.cost_labels, scene.cost, strict=True)}
    return {
        join_key(("cost", label, "norm", name)): float(norm[name])
        for label, norm in norms.items()
        if isinstance(norm, dict)
        for name in "pq"
        if isinstance(norm.get(name), int | float)
    }


class ClosedLoop:
    """Applies one control after the other, and publishes what is seen; for one thread.

    Plans are made beside it, in a separate thread (Alg. 1 of 2212.00541), and the newest one is followed: kernels
    and MuJoCo leave Python's lock to others. In lock step, and while paused or recording, every control waits for its
    own plan.

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
        self.lock_step = False
        """True where every control waits for its own plan."""
        self.speed = 1.0
        """Simulated seconds in a second of wall time that the plant is held to."""
        self.watched = True
        """True while anybody looks: else nothing is prepared to be seen of rollouts."""
        self.paused, self.planning, self.controlling = False, True, True
        self.tuned: dict[str, float] = {}
        """Weights and scalars changed since the start, by name."""
        self.keys: dict[str, str] = {}
        """Keys of the scene changed since the start, ``planner.samples`` and so on, with TOML values."""
        self.message = ""
        """Fate of the last change that could not be made; empty when all is well."""
        self._options = {"engine": engine, "device": device, "terms": tuple(terms)}
        self.build = self.episode = 0
        self._planner: PlannerThread | None = None  # begun by the first control that needs it
        self._recording, self._counter = RecordingSwitch(), PlanCounter()
        self._build(source, self.overrides, {}, seed)

    @property
    def asynchronous(self) -> bool:
        """Return whether the newest plan is followed, instead of one made for this control."""
        return self.planning and not (self.lock_step or self.paused or self._recording.path)

    def _step(self) -> None:
        observation = self.plant.observe()
        if self.asynchronous:
            timed = self._newest(observation)
            usable, self._plan, self._observed = timed.survived, timed.plan, timed.observed
            self._counts.append(timed.number - self._number)
            self._number = timed.number
            self._advance(observation, usable, seen=observation)
            return
        with self._alone():
            if self._planner is not None:
                self._planner.forget()
            if self.planning:
                self._plan, self._observed = self.controller.plan(observation), observation.time
                self._counts.append(1)
                self._look()
            self._advance(observation, not (self.planning and self.controller.info.fallback))
            if self.controller.info is not None:
                self._recording.log(self._control)

    def _newest(self, observation: State) -> TimedPlan:
        """The newest plan, from an observation before this one, but for the first."""
        if self._planner is None:
            self._planner = PlannerThread(self.controller, on_plan=self._look)
            self._planner.__enter__()
            self._number = -1
        planner = self._planner
        planner.planning.speed = self.speed
        planner.observe(TimedObservation(observation, self._control.copy(), self._following))
        end = time.monotonic() + FIRST_PLAN
        try:
            while (timed := planner.newest()) is None:
                if time.monotonic() > end:
                    raise TimeoutError(f"no plan after {FIRST_PLAN:g} s")
                time.sleep(1e-3)
        except Exception:
            self._end_planner()  # the next session begins another
            raise
        return timed

    def _advance(self, observation: State, usable: bool, *, seen: State | None = None) -> None:
        """Apply a control of the plan, or the safe one where that is not usable, and publish."""
        self._control = self._command(observation, usable)
        if self.planning:
            self.foresight.note(self._control, seen)
        else:
            self.foresight.forget()
        self.plant.apply(self._control)
        self._publish()

    def _command(self, observation: State, usable: bool) -> np.ndarray:
        plan, layout = self._plan, self.plant.layout
        self._age = float("nan") if plan is None else observation.time - self._observed
        usable = usable and plan is not None
        ended = usable and not (self.planning and not self.asynchronous) and observation.time > plan.times[-1]
        self._status = "the plan has ended" if ended else "running"
        self._following = self.controlling and usable and not ended
        if self._following:
            return plan.at(observation.time, observation)
        dt = self.plant.scene.timing.control_dt
        safe = safe_command(layout, observation.joint_q[None], observation.joint_qd[None], dt)[0]
        return np.clip(safe, layout.control_lower, layout.control_upper)

    def _look(self) -> None:
        """Count the plan just made and see what it came to, if it is time to; in the thread that made it."""
        self._counter.note(self.controller.info.plan_ms)
        now = time.perf_counter()
        if not self.watched or (now - self._published < PUBLISH and not self.paused):
            return
        self._published = now
        if self.controller.info.fallback:
            self._rollouts.clear()
        else:
            self._rollouts.update()
        if now - self._compared >= COMPARE:
            self._foreseen, self._compared = self.foresight.compare() or self._foreseen, now

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """No plan is made meanwhile in the planner's thread."""
        with nullcontext() if self._planner is None else self._planner.planning.held():
            yield

    def _end_planner(self) -> None:
        planner, self._planner = self._planner, None
        if planner is not None:
            planner.__exit__()

    # ---- what is changed

    def _build(self, source: str, overrides: Sequence[str], keys: dict[str, str], seed: int) -> None:
        """Another scene, seed or plant; what there was stays if it cannot be built."""
        scene = load_scene(source, overrides=[*overrides, *_texts(keys)])
        measured = scene.planner.samples is SampleCount.AUTO  # by optimized kernels
        with self._alone(), nullcontext(Later()) if measured else quick() as later:
            options = {**self._options, "engine": "auto"} if "engine.name" in keys else self._options
            episode = Episode(scene, seed=seed, compiled=compile_shared(scene), **options)
            shown = ShownRollouts(episode.controller), ForesightMeter(episode.controller, episode.plant)
        self._end_planner()
        if source != self.source:
            self.tuned = {}
        self.source, self.overrides, self.keys, self.seed = source, tuple(overrides), keys, seed
        self.scene, self.controller, self.plant = episode.scene, episode.controller, episode.plant
        self._rollouts, self.foresight = shown
        self._optimize(later)
        self.build += 1
        self._begin()

    def _optimize(self, later: Later) -> None:
        """Begin to compile with optimization what runs without for now."""
        self._later = later
        if later.modules:
            logger.info("%s: planning with code that is not optimized while that is compiled", self.scene.name)
            later.start()

    def _hand_over(self) -> None:
        """Go on in the same episode with a controller whose code is optimized, from the last plan."""
        self._later = Later()
        self._replace(self.scene)
        logger.info("%s: planning with optimized code from t = %.2f s on", self.scene.name, self.plant.time)

    def _start_recording(self) -> None:
        self._end_planner()
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
        self._number, self._following = -1, False
        self._observed, self._age = 0.0, float("nan")
        self._counter.forget()
        self._counts: deque[int] = deque(maxlen=COUNTED)
        self._control = np.zeros(self.plant.layout.nu, np.float32)
        self._plan: Plan | None = None
        self.foresight.clear()
        self._foreseen: Foreseen | None = None
        self._published, self._compared, self._status = 0.0, 0.0, "running"
        self._rollouts.clear()
        self._publish()

    def _reset(self, seed: int | None) -> None:
        if seed is not None and seed != self.seed:
            self._build(self.source, self.overrides, self.keys, seed)
            return
        with self._alone():
            self.plant.reset()
            self.controller.reset()
            if self._planner is not None:
                self._planner.forget()
            self._begin()

    def _set_keys(self, changed: dict[str, str]) -> None:
        keys = {**self.keys, **changed}
        if changed.keys() == {"agent.plans"}:
            agent = load_scene(self.source, overrides=[*self.overrides, *_texts(keys)]).agent
            self._end_planner()
            self.scene = self.controller.scene = self.scene.model_copy(update={"agent": agent})
            self.keys = keys
        elif all(map(_PLANNED.match, changed)) and not self._conditioned(changed):
            self._replan(keys)
        else:
            self._build(self.source, self.overrides, keys, self.seed)

    def _conditioned(self, changed: Iterable[str]) -> bool:
        """Return whether the plant, too, evaluates a term that changes, for success or phases."""
        return any(
            key.startswith(f"{join_key(('cost', term))}.") for key in changed for term in self.scene.watched_terms
        )

    def _replan(self, keys: dict[str, str]) -> None:
        """A controller of the same task with another planner or other norms, once it has made a plan."""
        loaded = load_scene(self.source, overrides=[*self.overrides, *_texts(keys)])
        scene = self.scene.model_copy(update={"planner": loaded.planner, "cost": loaded.cost})
        if not isinstance(loaded.planner.samples, int):
            scene = with_samples(scene, self.controller.shape.samples)  # measured at the start
        with quick() as later:
            self._replace(scene)
        self.keys = keys
        self._optimize(later)

    def _replace(self, scene: Scene) -> None:
        """Another controller of the same task and bodies, which goes on from the last plan."""
        old = self.controller
        with self._alone():
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
        self._end_planner()
        self._recording.stop()
        self.scene, self.controller = scene, controller
        self._rollouts, self.foresight, self._foreseen = *shown, None
        self._publish()

    def _publish(self) -> None:
        plant, task = self.plant, self.controller.task
        info = self.controller.info if self.planning else None
        if info is None:
            self._rollouts.clear()
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
            joint_q=plant.state.joint_q,
            sensor=plant.sensors,
            poses={name: task.pose(name).copy() for name in task.pose_name},
            values={name: float(task[name]) for name in (*task.weight_name, *task.scalar_name)}
            | norm_values(self.scene),
            paths=self._rollouts.paths,
            forecast=self._rollouts.forecast,
            forces=forces,
            pull=plant.perturbation.spring,
            control=np.array(self._control),
            cost=nothing if info is None else info.cost,
            eta=nothing if info is None else info.eta,
            proposer="" if info is None else info.proposer,
            beta=nothing if info is None else info.beta,
            plan_ms=nothing if info is None else info.plan_ms,
            plans=float(np.mean(self._counts)) if self._counts and self.planning else nothing,
            rate=self._counter.now(),
            age=self._age,
            foreseen=self._foreseen,
            status=status,
            paused=self.paused,
            planning=self.planning,
            controlling=self.controlling,
            lock_step=self.lock_step,
            recording=str(self._recording.path or ""),
            message=self.message,
        )


def _texts(keys: dict[str, str]) -> list[str]:
    return [f"{key}={value}" for key, value in keys.items()]
