# SPDX-License-Identifier: Apache-2.0
"""One closed-loop episode: controller and plant of a scene until the goal, the time-out or a divergence."""

from __future__ import annotations

import logging
import math
from collections import Counter, deque
from collections.abc import Callable, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from ...scene.draw import draw_task
from ...scene.model.compiled import CompiledScene, compile_scene
from ...scene.overrides import split_key
from ...scene.registry import OBSERVERS
from ..realtime.planning import Predictor
from .fit_samples import fit_to_machine, with_samples
from .result import EpisodeResult

if TYPE_CHECKING:
    from ...cost.term import UserTerm
    from ...planner.controller.controller import Controller
    from ...scene.model.state import Info, State
    from ...scene.schema import Scene
    from ..plant.plant import Plant

logger = logging.getLogger("warpmpc")

BODIES = ("robot", "object", "obstacle", "ground")
"""Sections of a scene that its compiled form depends on."""
OBSERVED = ("foresight", "verdict", "shortfall")
"""Fields of a result that observers give."""
KEPT = 10
"""Seeds whose drawn bodies are kept compiled on disk, so that a run is quick to start again; others would fill it."""


class Recorder(Protocol):
    """Receiver of an episode's steps, such as :class:`warpmpc.extras.record.recorder.Recorder`."""

    def log(self, control: np.ndarray) -> None:
        """Take note of the step just made and the control ``[nu]`` that made it."""

    def close(self) -> None:
        """Finish the recording."""


class Observer(Protocol):
    """What looks at an episode and adds to its result; the extras bring one as an entry point (``warpmpc.observers``).

    It is made with ``scene``, ``controller``, ``plant`` and ``terms``.
    """

    def note(self, info: Info, control: np.ndarray) -> None:
        """Look at the plan just made and its control ``[nu]``, before it is applied."""

    def found(self, *, failed: bool, interrupted: bool) -> dict[str, object]:
        """Those fields of :class:`EpisodeResult` in :data:`OBSERVED` that it knows.

        Args:
            failed: Whether the episode ended without what it was to reach.
            interrupted: Whether it was ended from outside, by Ctrl-C for example; then there is no time to wait.
        """


@cache
def _observer(name: str) -> Callable[..., Observer] | None:
    """What makes an observer; None, with a warning, where its package cannot be loaded."""
    try:
        return OBSERVERS[name]
    except ValueError as error:
        logger.warning("%s", error)
        return None


class EpisodeInterrupted(KeyboardInterrupt):
    """Ctrl-C during an episode; ``result`` tells how far it came."""

    def __init__(self, result: EpisodeResult):
        super().__init__("the episode was interrupted")
        self.result = result


class EpisodeStats:
    """Adds up the plans of one episode.

    Args:
        drawn: Values drawn for it by scene key.
        terms: Users' own cost terms that the scene names.
    """

    def __init__(
        self,
        scene: Scene,
        seed: int,
        drawn: dict[str, object],
        controller: Controller,
        plant: Plant,
        terms: Sequence[UserTerm] = (),
    ):
        self.scene, self.seed, self.drawn, self.controller, self.plant = scene, seed, drawn, controller, plant
        self._plans: list[tuple[float, dict[str, float]]] = []  # wall time of each plan and of its stages [ms]
        self._proposed: Counter[str] = Counter()
        self._diverged = self._fallbacks = 0
        self._cost = math.nan
        makes = filter(None, map(_observer, OBSERVERS))
        self._observers: list[Observer] = [make(scene, controller, plant, terms) for make in makes]

    def note(self, info: Info, control: np.ndarray) -> None:
        """Keep the numbers of the plan just made and its control ``[nu]``, before it is applied."""
        for observer in self._observers:
            observer.note(info, control)
        self._plans.append((info.plan_ms, info.stages_ms))
        self._proposed.update([info.proposer, *["lowered"] * (info.lowered > 0.0)])
        self._diverged += info.diverged_worlds
        self._fallbacks += info.fallback
        self._cost = info.cost

    def result(self, *, reason: str | None = None) -> EpisodeResult:
        """The result as of now.

        Args:
            reason: Why the episode ended before its plant was done.
        """
        scene, controller, plant = self.scene, self.controller, self.plant
        error, goal = plant.error, scene.goal
        oriented = goal is not None and (goal.yaw is not None or goal.rotation is not None)
        failed = not plant.success and (scene.success is not None or plant.reason != "timeout")
        found: dict[str, Any] = {}
        for observer in self._observers:
            for name, value in observer.found(failed=failed, interrupted=reason is not None).items():
                if name not in OBSERVED or name in found:
                    logger.warning("%s of %s is left out of the result", name, type(observer).__name__)
                else:
                    found[name] = value
        plans = self._plans or [(math.nan, dict.fromkeys(controller.plan_step.stages, math.nan))]
        p50, p90, p99, longest = np.percentile([plan for plan, _ in plans], [50, 90, 99, 100]).tolist()
        return EpisodeResult(
            scene=scene.name,
            variant=scene.variant,
            seed=self.seed,
            engine=controller.engine.name,
            device=controller.device,
            success=plant.success if scene.success else None,
            reason=plant.reason if plant.success else reason or plant.reason,
            sim_time=plant.time,
            steps=plant.steps,
            position_error=None if error is None else error.position,
            yaw_error=error.yaw if oriented else None,
            cost=self._cost,
            max_force=plant.contact.max_force if plant.pairs else None,
            time_in_contact=plant.contact.time if plant.pairs else None,
            plan_ms={"p50": p50, "p90": p90, "p99": p99, "max": longest},
            stages_ms={name: float(np.median([stages[name] for _, stages in plans])) for name in plans[0][1]},
            diverged_worlds=self._diverged,
            samples=controller.shape.samples,
            horizon=controller.shape.horizon,
            fallbacks=self._fallbacks,
            envs=controller.envs,
            axis_error=error.worst_axis(scene.success) if error and scene.success else None,
            phases=tuple(plant.monitor.phases),
            reached=plant.monitor.reached if scene.phase else None,
            drawn=self.drawn,
            proposers={name: count / len(plans) for name, count in self._proposed.most_common()}
            if controller.plan_step.refiner
            else {},
            mean_cost=None if scene.success else plant.mean_cost,
            **found,
        )


class Present:
    """Predicts observations of an episode to the present where the scene estimates what it observes late.

    Without an estimate observations stay as late as ``plant.delay`` makes them, and with ``agent.compensate = false``.

    Args:
        scene: The scene, drawn for the episode.
        controller: Its controller.
    """

    def __init__(self, scene: Scene, controller: Controller):
        self._dt = scene.timing.control_dt
        late = round(scene.plant.delay / self._dt)
        self._predict = None
        if late and scene.agent.compensate and (scene.estimate or scene.estimate_base):
            self._predict = Predictor(scene, controller.compiled, controller.layout, controller.task)
        self._sent: deque[np.ndarray] = deque(maxlen=late)

    def sent(self, control: np.ndarray) -> None:
        """Take note of a control ``[nu]`` that acts from now on for one control step."""
        self._sent.append(np.array(control))

    def __call__(self, state: State, now: float) -> State:
        """The state now [s], from one that was observed earlier."""
        duration = now - float(state.time)
        if self._predict is None or not self._sent or duration <= 0.0:
            return state

        def acting(time: float, _: State) -> np.ndarray:
            ago = int((now - time) / self._dt - 1e-6)  # whole controls
            return self._sent[-1 - min(ago, len(self._sent) - 1)]

        return self._predict(state, acting, duration)


class Episode:
    """An episode ready to run: the task drawn, the scene compiled, controller and plant built.

    Args:
        scene: The scene; what its ``randomize_task`` names is drawn from the seed.
        seed: Seed of the task, of the controller's noise and of the plant's properties.
        engine: Engine of the rollouts, as for :class:`~warpmpc.Controller`.
        device: Device of the rollouts, as for :class:`~warpmpc.Controller`.
        terms: Users' own cost terms and ancillary controllers that the scene names.
        compiled: The scene compiled earlier (:func:`compile_shared`), to save doing it again.
        measure: Whether samples, engine and device that are left open are measured although they are known.

    Raises:
        SceneError: If the scene names anything that does not exist, or no task can be drawn.
        ValueError: If the engine or device is unknown or not available here.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        seed: int = 0,
        engine: str = "auto",
        device: str = "auto",
        terms: Sequence[UserTerm] = (),
        compiled: CompiledScene | None = None,
        measure: bool = False,
    ):
        from ...planner.controller.controller import (
            Controller,  # slow to import, and a scene may prove wrong without them
        )
        from ..plant.plant import Plant

        self.seed = seed
        self.scene, self.drawn = draw_task(scene, seed)
        if compiled is None or draws_bodies(scene):
            compiled = compile_scene(self.scene, cache=seed < KEPT or not draws_bodies(scene))
        fitted = fit_to_machine(scene, engine=engine, device=device, terms=terms, compiled=compiled, measure=measure)
        samples, engine, device = fitted
        self.scene = with_samples(self.scene, samples)
        self.controller = Controller(
            self.scene, engine=engine, device=device, seed=seed, terms=terms, compiled=compiled
        )
        keys = {"seed": seed, "terms": terms, "watch": watched(self.scene), "compiled": compiled}
        self.plant = Plant(self.scene, task=self.controller.task, **keys)
        self._present = Present(self.scene, self.controller)
        self._stats = EpisodeStats(self.scene, seed, self.drawn, self.controller, self.plant, terms)

    def run(
        self,
        *,
        recorder: Recorder | None = None,
        on_step: Callable[[Controller, Plant, np.ndarray], None] | None = None,
    ) -> EpisodeResult:
        """Observe, plan and apply until the plant is done.

        One plan is made and forgotten beforehand, so that compiling kernels and first touching memory do not count
        as planning time; it changes nothing else.

        Args:
            recorder: Logs every step; closed at the end, whatever ends the episode.
            on_step: Called as ``on_step(controller, plant, control)`` after every step.

        Raises:
            EpisodeInterrupted: On Ctrl-C.
        """
        controller, plant = self.controller, self.plant
        try:
            observation = self.observe()
            if not plant.done:
                controller.step(observation)
                controller.reset()
            while not plant.done:
                control = controller.step(observation)
                self._stats.note(controller.info, control)
                plant.apply(control)
                self._present.sent(control)
                if recorder is not None:
                    recorder.log(control)
                if on_step is not None:
                    on_step(controller, plant, control)
                observation = self.observe()
            return self._stats.result()  # which takes a while: what was foreseen is rolled out
        except KeyboardInterrupt:
            raise EpisodeInterrupted(self._stats.result(reason="interrupted")) from None
        finally:
            if recorder is not None:
                recorder.close()

    def observe(self) -> State:
        """The plant's state now, as it is known."""
        return self._present(self.plant.observe(), self.plant.time)


def run_episode(
    scene: Scene,
    *,
    recorder: Callable[[Controller, Plant], Recorder] | None = None,
    on_step: Callable[[Controller, Plant, np.ndarray], None] | None = None,
    **options: Any,
) -> EpisodeResult:
    """Run one episode of a scene.

    Args:
        scene: The scene; what its ``randomize_task`` names is drawn from the seed.
        recorder: Makes the recorder of this episode from its controller and plant, such as
            ``functools.partial(warpmpc.extras.record.recorder.Recorder, "run.rrd")``.
        on_step: Called as ``on_step(controller, plant, control)`` after every step.
        options: ``seed``, ``engine``, ``device``, ``terms`` and ``compiled``, as for :class:`Episode`.

    Raises:
        EpisodeInterrupted: On Ctrl-C; other errors are those of :class:`Episode`.
    """
    episode = Episode(scene, **options)
    made = recorder(episode.controller, episode.plant) if recorder else None
    return episode.run(recorder=made, on_step=on_step)


def watched(scene: Scene) -> list[str]:
    """Cost terms that an episode's plant watches: all where the run's cost is its result."""
    return scene.cost_labels if scene.success is None else []


def draws_bodies(scene: Scene) -> bool:
    """Return whether the episodes of a scene differ in what is compiled, not just in their goals."""
    return any(is_of_bodies(key) for key in scene.randomize_task.draw)


def is_of_bodies(key: str) -> bool:
    """Return whether what is compiled depends on a key of the scene."""
    first, *rest = split_key(key)
    return first in BODIES or (first == "engine" and rest[:1] == ["gravity"])


def compile_shared(scene: Scene) -> CompiledScene | None:
    """The compiled scene that all episodes of a scene can share; None when each has its own bodies.

    Raises:
        SceneError: If an asset is missing or broken, or lacks a joint or link the scene names.
    """
    return None if draws_bodies(scene) else compile_scene(scene)
