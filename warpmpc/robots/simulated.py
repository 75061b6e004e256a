# SPDX-License-Identifier: Apache-2.0
"""The simulated plant that takes commands at the agent's rate."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

from ..model.compiled import CompiledScene, compile_scene
from ..plant.plant import Plant
from ..plant.worlds import SUBSTEPS

if TYPE_CHECKING:
    from ..cost.term import UserTerm
    from ..scene.schema import Scene
    from ..task.task import Task


def simulated_robot(
    scene: Scene,
    *,
    seed: int = 0,
    task: Task | None = None,
    terms: Sequence[UserTerm] = (),
    watch: Collection[str] = (),
    compiled: CompiledScene | None = None,
) -> Plant:
    """The scene's plant, moved on by one tick of ``agent.rate`` with every command; physics steps are not longer.

    Args:
        scene: The scene.
        seed: Seed of the plant's properties and noise.
        task: What the run wants, shared with the planner (``planner.task``); one of its own if None.
        terms: Users' own cost terms that success, failures, phases or ``watch`` name.
        watch: Cost terms whose values the plant's ``terms`` shall have.
        compiled: The scene compiled earlier, to save doing it again.

    Raises:
        SceneError: As :class:`~warpmpc.Plant`.
    """
    compiled = compiled or compile_scene(scene)
    timing, tick = scene.timing, 1.0 / scene.agent.rate
    physics = timing.control_dt / compiled.substeps(scene.plant.substeps, timing.control_dt, SUBSTEPS)
    substeps = max(1, math.ceil(tick / physics - 1e-6))
    faster = scene.model_copy(
        update={
            "timing": timing.model_copy(update={"control_dt": tick}),
            "plant": scene.plant.model_copy(update={"substeps": substeps}),
        }
    )
    return Plant(faster, seed=seed, task=task, terms=terms, watch=watch, compiled=compiled)
