# SPDX-License-Identifier: Apache-2.0
"""Worlds of one engine, in which simulated plants live."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from ...cost.plant_values import TermValues
from ...engine.mujoco import MujocoSimulator
from ...physics.runtime.launch import CapturedLaunches, capturing
from ...scene.model.compiled import CompiledScene
from ...scene.model.mujoco_model import Options
from ...scene.model.overlaps import refuse_overlap
from ...scene.model.pairs import collision_pairs, touching_pairs
from ...scene.model.properties import Properties, draw_properties, with_factors
from ...scene.model.trajectory import BatchSize
from ...scene.task.observed import ObservedState
from ...scene.task.task import Task, task_layout
from .monitor import Monitor

if TYPE_CHECKING:
    from ...cost.term import UserTerm
    from ...scene.schema import Scene

SUBSTEPS = 8
"""Physics steps per control where neither the scene nor an MJCF file says anything: finer than the planner's."""
SOLVER = {"iterations": 100, "tolerance": 1e-8}
"""The constraint solver of plants, more careful than the rollouts'; with an MJCF file, the file's own."""


class Worlds:
    """Worlds of one engine at the start state, for one plant each.

    Args:
        scene: The scene.
        compiled: The scene, compiled.
        seeds: Seeds of the plants' properties.
        task: What the plants' runs want, one environment for each of them.
        terms: Users' own cost terms that conditions name or ``watch`` names.
        watch: Further cost terms to evaluate.

    Raises:
        ValueError: If the task has more or fewer environments than there are plants.
    """

    def __init__(
        self,
        scene: Scene,
        compiled: CompiledScene,
        seeds: Sequence[int],
        task: Task,
        terms: Sequence[UserTerm] = (),
        watch: Collection[str] = (),
    ):
        if task.envs != len(seeds):
            raise ValueError(
                f"{len(seeds)} plants share a task of {task.envs} environments: say Plant(scene, envs={task.envs}, ...)"
            )
        self.task = task
        self.layout = task_layout(compiled.layout, scene)
        self.draws = None
        if scene.plant.randomize or scene.plant.factor:
            drawn = [
                draw_properties(scene, self.layout, 1, seed=2 * seed + 1) if scene.plant.randomize else None
                for seed in seeds
            ]
            self.draws = [with_factors(draw, scene, self.layout) for draw in drawn]
        self.monitors = [Monitor(scene, task=task, e=e, compiled=compiled) for e in range(len(seeds))]
        watched = scene.watched_terms.union(watch)
        self._values = TermValues(scene, self.layout, task, watched, terms=terms) if watched else None
        watching = self._values.pairs if self._values else ()
        supports = {obstacle.name for obstacle in scene.obstacle if obstacle.support}
        self.pairs = collision_pairs(self.layout, supports)
        self.touching = touching_pairs(self.layout)
        self.first_pair = len(watching)
        shape, dt = BatchSize(len(seeds), 1, 1, 1), scene.timing.control_dt
        substeps = compiled.substeps(scene.plant.substeps, dt, SUBSTEPS)
        self.engine = MujocoSimulator(
            compiled,
            shape,
            substeps=[substeps],
            timestep=dt / substeps,
            pairs=(*watching, *self.pairs, *self.touching),
            properties=_stacked(self.draws) if self.draws else None,
            threads=1 if len(seeds) == 1 else 0,
            options=Options.of(scene.engine, **({} if compiled.mjcf_robots else SOLVER)),
            pushed=True,
        )
        self.engine.clone(ObservedState.allocate(self.layout, task, "cpu"))
        for e, (model, start) in enumerate(zip(self.engine.models, self.engine.initial, strict=True)):
            grown = max(0.0, float(self.draws[e].size.max(initial=0.0))) if self.draws else 0.0
            refuse_overlap(scene, compiled, model, start, grown=grown)
        self.control = self.engine.trajectory.control
        """Controls of all worlds ``[1, E, nu]``."""
        if self._values:
            self._values.attach(self.engine.trajectory, self.control, shape, dt)
        parts = range(len(self.engine.parts))
        self._replays = [CapturedLaunches(partial(self.engine.rollout_part, self.control, part)) for part in parts]
        self.terms: list[dict[str, float]] = [{} for _ in seeds]
        """Values of the cost terms that conditions name or ``watch`` lists, by world."""

    def step(self, times: Sequence[float]) -> None:
        """Hold the controls for one control step in every world.

        Args:
            times: Time of each world before it ``[E]`` [s].
        """
        self.engine.run(self._replays)
        if self._values:
            with capturing:
                self.terms = self._values(times)


def _stacked(draws: Sequence[Properties]) -> Properties:
    """Draws of one plant each as draws of one batch."""
    rows = (np.concatenate([getattr(draw, field) for draw in draws]) for field in ("mass", "friction", "size"))
    return Properties(draws[0].names, *rows)
