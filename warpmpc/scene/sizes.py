# SPDX-License-Identifier: Apache-2.0
"""Sizes that no machine can take, refused before anything is allocated."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from .errors import SceneError
from .schema import SampleCount

if TYPE_CHECKING:
    from .schema import Scene

PLAN_STEPS = 200_000_000
"""Most physics steps of a plan: a small scene's take minutes on two cores, seconds on the largest GPU."""
PLAN_ROUNDS = 1000
"""Most iterations of a plan: each of them is prepared, however few its samples are."""
RUN_CONTROLS = 100_000_000
"""Most controls of a run."""
SHORTEST = 1e-6
"""Shortest physics step [s]; a run's time in single precision tells no shorter ones apart."""
THREADS = 1024
"""Most CPU threads."""
POINTS = 10_000_000
"""Most points of a cloud."""

_USUAL = {"samples": 256, "horizon": 16, "iterations": 1, "domains": 1}
"""What the factors of a plan's work are without more ado, to tell which of them is out of bounds."""


def check_sizes(scene: Scene) -> None:
    """Refuse what would take hours or all memory.

    Raises:
        SceneError: If a size is out of all bounds; it names the key that is farthest from what is usual.
    """
    planner, timing, engine = scene.planner, scene.timing, scene.engine
    controls = timing.timeout / timing.control_dt
    if controls > RUN_CONTROLS:
        key = "timing.control_dt" if timing.control_dt < 1e-4 else "timing.timeout"
        what = f"a run of {timing.timeout:g} s would have {controls:.0g} controls, more than {RUN_CONTROLS:.0g}"
        raise SceneError(what, key=key, found=getattr(timing, key.partition(".")[2]))
    for key, substeps, length in (
        ("engine.substeps", engine.substeps, timing.control_dt if planner.dt is None else _shortest_step(scene)),
        ("plant.substeps", scene.plant.substeps, timing.control_dt),
    ):
        if substeps is not None and length / substeps < SHORTEST:
            what = f"physics steps of {length / substeps:.1g} s are too short: {SHORTEST:g} s at least"
            raise SceneError(what, key=key, found=substeps, allowed=f"at most {max(1, math.floor(length / SHORTEST))}")
    sizes = plan_sizes(scene)
    steps = math.prod(sizes.values()) * (engine.substeps or 1)
    if steps > PLAN_STEPS:
        name = farthest(sizes)
        what = f"a plan would take {steps:.1e} physics steps, more than {PLAN_STEPS:.0e}: lower this"
        raise SceneError(what, key=f"planner.{name}", found=sizes[name])
    if planner.iterations > PLAN_ROUNDS:
        what = f"more than {PLAN_ROUNDS} rounds of a plan take minutes however few their samples: lower this"
        raise SceneError(what, key="planner.iterations", found=planner.iterations)
    if engine.threads > THREADS:
        allowed = f"at most {THREADS}, or 0 for one on each core"
        raise SceneError("no machine has so many cores", key="engine.threads", found=engine.threads, allowed=allowed)
    for cloud in scene.cloud:
        if cloud.capacity > POINTS:
            key = f"cloud.{cloud.name}.capacity"
            raise SceneError("is too large", key=key, found=cloud.capacity, allowed=f"at most {POINTS}")


def plan_sizes(scene: Scene) -> dict[str, int]:
    """Factors of a plan's work, by keys of the planner; the usual where a number is left to the machine."""
    sizes = {name: getattr(scene.planner, name) for name in _USUAL}
    return sizes | {name: _USUAL[name] for name, value in sizes.items() if value is SampleCount.AUTO}


def farthest(sizes: dict[str, int]) -> str:
    """The key of :func:`plan_sizes` that is farthest from what is usual."""
    return max(sizes, key=lambda name: sizes[name] / _USUAL[name])


def _shortest_step(scene: Scene) -> float:
    """Length of the shortest step of a rollout [s]."""
    dt = scene.planner.dt
    return min(dt) if isinstance(dt, tuple) else min(dt.first, dt.last)
