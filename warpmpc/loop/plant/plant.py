# SPDX-License-Identifier: Apache-2.0
"""Simulated plants, one or several at once.

Several independent plants, stepped as one.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ...physics.runtime.launch import capturing
from ...scene.model.compiled import CompiledScene, compile_scene
from ...scene.model.state import State
from ...scene.task.task import Task
from .simulated import SimulatedPlant
from .worlds import Worlds

if TYPE_CHECKING:
    from ...cost.term import UserTerm
    from ...scene.schema import Scene


class PlantBatch:
    """E plants that are observed and commanded together, made by ``Plant(scene, envs=E)``.

    Plant e is bit for bit the one that ``Plant(scene, seed=seeds[e])`` makes, with properties, noise, delay and kicks
    of its own. One that is done stays where it is and takes no more steps. All of them live in the worlds of one
    engine, so that a step is one call into MuJoCo's thread pool.

    Args:
        scenes: Scene of every plant; they differ in nothing but their goals.
        seeds: Seed of every plant's properties and noise.
        task: What the runs want, one environment for each plant; the scenes' goals if None.
        terms: Users' own cost terms that success, failures, phases or ``watch`` name.
        watch: Cost terms whose values the plants' ``terms`` shall have.
        compiled: The scene compiled earlier, to save doing it again.

    Raises:
        SceneError: If a kick has the wrong number of values.
        ValueError: If the task has more or fewer environments than there are plants.
    """

    plants: tuple[SimulatedPlant, ...]
    """The plants, each with ``state``, ``error``, ``contact``, ``reason`` and so on of its own."""

    def __init__(
        self,
        scenes: Sequence[Scene],
        *,
        seeds: Sequence[int],
        task: Task | None = None,
        terms: Sequence[UserTerm] = (),
        watch: Collection[str] = (),
        compiled: CompiledScene | None = None,
    ):
        self.scene, self.seeds = scenes[0], tuple(seeds)
        self.compiled = compiled or compile_scene(self.scene)
        self.task = task or Task(self.scene, envs=len(scenes))
        if task is None:
            self.task.take([Task(scene) for scene in scenes])
        with capturing:  # nothing may be allocated while a controller records its plan
            self._worlds = Worlds(self.scene, self.compiled, self.seeds, self.task, terms, watch)
        self.layout = self._worlds.layout
        self.plants = tuple(
            SimulatedPlant(scene, seed=seed, compiled=self.compiled, world=(self._worlds, e))
            for e, (scene, seed) in enumerate(zip(scenes, self.seeds, strict=True))
        )
        self._engine = self._worlds.engine

    def reset(self) -> None:
        """Go back to the start states."""
        for plant in self.plants:
            plant.reset()

    @property
    def envs(self) -> int:
        """Number of plants E."""
        return len(self.plants)

    @property
    def time(self) -> float:
        """Simulated time of the plants that took every step [s]."""
        return max(plant.time for plant in self.plants)

    @property
    def state(self) -> State:
        """The true states, ``[E, nq]`` and ``[E, nv]``."""
        return _stacked([plant.state for plant in self.plants])

    def observe(self) -> State:
        """The states ``[E, nq]`` and ``[E, nv]`` as sensors show them: with noise, and ``delay`` old."""
        return _stacked([plant.observe() for plant in self.plants])

    def apply(self, control: np.ndarray) -> None:
        """Hold controls ``[E, nu]`` for one control step; rows of plants that are done do not matter.

        Raises:
            ValueError: If the controls have the wrong shape, or that of a running plant is not finite.
        """
        control = np.asarray(control, dtype=np.float32)
        running = self.running
        if control.shape != (self.envs, self.layout.nu) or not np.isfinite(control[running]).all():
            raise ValueError(f"controls of these plants are [{self.envs}, {self.layout.nu}] finite numbers")
        for e in np.flatnonzero(running):
            self.plants[e].begin(control[e])
        # the engine steps every world; what the worlds of finished plants showed is put back
        out = self._engine.trajectory
        shown = (
            out.joint_q.numpy(),
            out.joint_qd.numpy(),
            out.body_q.numpy(),
            out.act.numpy(),
            self._engine.sensor.swapaxes(0, 1),
        )
        kept = [array[:, ~running] for array in shown]
        self._worlds.step([plant.time for plant in self.plants])
        for array, old in zip(shown, kept, strict=True):
            array[:, ~running] = old
        for e in np.flatnonzero(running):
            self.plants[e].end()

    @property
    def running(self) -> np.ndarray:
        """Return which plants are not done yet, ``[E]`` bool."""
        return np.array([not plant.done for plant in self.plants])

    @property
    def success(self) -> np.ndarray:
        """Return which plants reached their goal and held it long enough, ``[E]`` bool."""
        return np.array([plant.success for plant in self.plants])

    @property
    def reasons(self) -> tuple[str, ...]:
        """Reasons for which each plant's episode is over."""
        return tuple(plant.reason for plant in self.plants)

    @property
    def done(self) -> bool:
        """Return whether every plant is done."""
        return all(plant.done for plant in self.plants)


def _stacked(states: Sequence[State]) -> State:
    """States of several plants as one with a leading axis."""
    return State(
        np.stack([state.joint_q for state in states]),
        np.stack([state.joint_qd for state in states]),
        np.array([state.time for state in states]),
        np.stack([state.act for state in states]),
        np.stack([state.mocap for state in states]),
    )


class Plant(SimulatedPlant):
    """A simulated plant with its own physical properties, noise, delay and disturbances.

    Args:
        scene: The scene; its ``plant`` table says how the plant differs from the planner's worlds.
        envs: Number of plants E. With more than one this makes a :class:`~warpmpc.loop.plant.plant.PlantBatch` of
            plants with the seeds ``seed, seed + 1, ...``, whose states and controls have a leading axis ``[E]``.
        keys: Those of :class:`~warpmpc.loop.plant.simulated.SimulatedPlant`.

    Raises:
        SceneError: If things stand deep inside each other at the start, or a kick has the wrong number of values.
        ValueError: If there is to be less than one plant, or not one for each environment of the task.
    """

    def __new__(cls, scene: Scene, *, seed: int = 0, envs: int = 1, **keys: object) -> Plant | PlantBatch:
        """Make a plant, or a batch of them."""
        if envs < 1:
            raise ValueError(f"there is at least one plant, not {envs}")
        if envs == 1:
            return super().__new__(cls)
        return PlantBatch([scene] * envs, seeds=range(seed, seed + envs), **keys)

    def __init__(self, scene: Scene, *, envs: int = 1, **keys: object):
        super().__init__(scene, **keys)
