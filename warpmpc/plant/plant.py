# SPDX-License-Identifier: Apache-2.0
"""Simulated plants, one or several at once."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .batch import PlantBatch
from .simulated import SimulatedPlant

if TYPE_CHECKING:
    from ..scene.schema import Scene


class Plant(SimulatedPlant):
    """A simulated plant with physical properties, noise, delay and disturbances of its own.

    Args:
        scene: The scene; its ``plant`` table says how the plant differs from the planner's worlds.
        envs: Number of plants E. With more than one this makes a :class:`~warpmpc.plant.batch.PlantBatch` of plants
            with the seeds ``seed, seed + 1, ...``, whose states and controls have a leading axis ``[E]``.
        keys: Those of :class:`~warpmpc.plant.simulated.SimulatedPlant`.

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
