# SPDX-License-Identifier: Apache-2.0
"""Many closed-loop episodes at once: one controller plans for several environments, each with its own plant."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ...scene.draw import draw_task
from ...scene.errors import SceneError
from ...scene.model.compiled import CompiledScene, compile_scene
from ...scene.model.state import State
from ...scene.overrides import split_key
from ...scene.task.task import Task
from .episode import EpisodeStats, watched
from .fit_samples import fit_to_machine, with_samples
from .result import EpisodeResult

if TYPE_CHECKING:
    from ...cost.term import UserTerm
    from ...planner.controller.controller import Controller
    from ...scene.schema import Scene
    from ..plant.plant import PlantBatch

OnStep = Callable[["Controller", "PlantBatch", np.ndarray], None]
"""Called as ``on_step(controller, plants, control [E, nu])`` after every step."""


class Batch:
    """Episodes ready to run, E at a time: the tasks drawn, the scene compiled, the controller built.

    The episodes run in rounds of E. An environment whose episode is over waits, masked, until its round is: it goes on
    being planned for, but no result counts that. The controller starts every round anew, with the seed of the first
    episode; the episodes' own seeds decide on tasks and plants.

    Args:
        scene: The scene; the goal that its ``randomize_task`` draws is each episode's own.
        seeds: Seeds of the episodes.
        envs: Largest number of environments E; never more than episodes.
        engine: Engine of the rollouts, as for :class:`~warpmpc.Controller`.
        device: Device of the rollouts, as for :class:`~warpmpc.Controller`.
        terms: Users' own cost terms and ancillary controllers that the scene names.
        compiled: The scene compiled earlier, to save doing it again.

    Raises:
        SceneError: If the scene draws more than goals, names anything that does not exist, or no task can be drawn.
        ValueError: If there are no episodes or environments, or engine or device is unknown or not available here.
    """

    def __init__(
        self,
        scene: Scene,
        seeds: Sequence[int],
        *,
        envs: int,
        engine: str = "auto",
        device: str = "auto",
        terms: Sequence[UserTerm] = (),
        compiled: CompiledScene | None = None,
    ):
        if envs < 1 or not len(seeds):
            raise ValueError(f"a batch has at least one environment and one episode, not {envs} and {len(seeds)}")
        _refuse_drawn_bodies(scene)
        from ...planner.controller.controller import (
            Controller,  # slow to import, and a scene may prove wrong without it
        )

        self.seeds, self.terms = tuple(seeds), tuple(terms)
        self.envs = min(envs, len(self.seeds))
        self._tasks = [(seed, *draw_task(scene, seed)) for seed in self.seeds]
        self.compiled = compiled or compile_scene(scene)
        shared = {"envs": self.envs, "terms": terms, "compiled": self.compiled}
        samples, engine, device = fit_to_machine(scene, engine=engine, device=device, **shared)
        scene = with_samples(scene, samples)
        self.controller = Controller(scene, engine=engine, device=device, seed=self.seeds[0], **shared)

    def run(self, *, on_step: OnStep | None = None) -> Iterator[EpisodeResult]:
        """Run all rounds; yields the result of every episode when it is over, in that order.

        One plan is made and forgotten beforehand, so that compiling kernels and first touching memory do not count
        as planning time. On Ctrl-C the results of the running episodes follow, with reason ``interrupted``, and then
        the ``KeyboardInterrupt``.

        Args:
            on_step: Called as ``on_step(controller, plants, control [E, nu])`` after every step.
        """
        layout = self.controller.layout
        self.controller.step(State(*(np.tile(start, (self.envs, 1)) for start in (layout.joint_q, layout.joint_qd))))
        for first in range(0, len(self.seeds), self.envs):
            yield from self._round(self._tasks[first : first + self.envs], on_step)

    def _round(self, tasks: list[tuple[int, Scene, dict[str, object]]], on_step: OnStep | None):
        from ..plant.plant import PlantBatch

        # where a last round has fewer episodes than environments, the rest repeats its last one for nothing
        filled = tasks + tasks[-1:] * (self.envs - len(tasks))
        controller = self.controller
        controller.task.take([Task(scene) for _, scene, _ in filled])
        plants = PlantBatch(
            [scene for _, scene, _ in filled],
            seeds=[seed for seed, _, _ in filled],
            task=controller.task,
            terms=self.terms,
            watch=watched(tasks[0][1]),
            compiled=self.compiled,
        )
        controller.reset()
        running = {
            e: EpisodeStats(scene, seed, drawn, controller, plants.plants[e], self.terms)
            for e, (seed, scene, drawn) in enumerate(tasks)
        }
        try:
            while True:
                for e in [e for e, statistics in running.items() if statistics.plant.done]:
                    yield running.pop(e).result()
                if not running:
                    return
                control = controller.step(plants.observe())
                for e, statistics in running.items():
                    statistics.note(controller.info[e], control[e])
                plants.apply(control)
                if on_step is not None:
                    on_step(controller, plants, control)
        except KeyboardInterrupt:
            for statistics in running.values():
                yield statistics.result(reason="interrupted")
            raise


def run_batch(
    scene: Scene, seeds: Sequence[int], *, envs: int, on_step: OnStep | None = None, **options: Any
) -> Iterator[EpisodeResult]:
    """Run episodes of a scene, several at once.

    Args:
        scene: The scene; the goal that its ``randomize_task`` draws is each episode's own.
        seeds: Seeds of the episodes.
        envs: Largest number of environments E; never more than episodes.
        on_step: Called as ``on_step(controller, plants, control [E, nu])`` after every step.
        options: ``engine``, ``device``, ``terms`` and ``compiled``, as for :class:`Batch`, whose errors are raised.

    Returns:
        Results of the episodes in the order in which they end; they run as you iterate.
    """
    return Batch(scene, seeds, envs=envs, **options).run(on_step=on_step)


def _refuse_drawn_bodies(scene: Scene) -> None:
    """Refuse scenes whose episodes differ in more than their goals.

    Raises:
        SceneError: If this is one.
    """
    others = [key for key in scene.randomize_task.draw if split_key(key)[0] != "goal"]
    others += [f"phase.{phase.name}.goal.rotation" for phase in scene.phase if phase.draw_rotation]
    if others:
        raise SceneError(
            f"episodes that differ in more than their goals ({', '.join(others)}) cannot run as one batch: "
            "run them one after another, without --envs",
            key="randomize_task.draw",
            file=scene.path,
        )
