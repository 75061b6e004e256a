# SPDX-License-Identifier: Apache-2.0
"""As many samples as fit into a control on this machine, for scenes that leave their number open."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from ..model.compiled import cache_folder, compile_scene
from ..scene.schema import SampleCount
from .choose_engine import check_plan_time, choose_engine, keep, plan_time, read_kept, timing_key, with_samples

if TYPE_CHECKING:
    from ..cost.term import UserTerm
    from ..model.compiled import CompiledScene
    from ..scene.schema import Scene

logger = logging.getLogger("warpmpc")

FEWEST, MOST = 32, 8192
"""Bounds of what is chosen."""
SHARE = 0.6
"""Share of a control that plans may take: what else a robot does, and plans that take longer than others."""


def fit_samples(
    scene: Scene,
    *,
    engine: str = "auto",
    device: str = "auto",
    envs: int = 1,
    terms: Sequence[UserTerm] = (),
    compiled: CompiledScene | None = None,
) -> Scene:
    """A scene with ``planner.samples = "auto"`` with the number that fits this machine, any other as it is.

    A few plans are timed with more and more samples. What came of it is kept on disk by scene (before any random
    draws), batch and hardware.

    Args:
        scene: The scene, before its task is drawn.
        engine: The engine of the rollouts.
        device: Their device.
        envs: Number of environments.
        terms: Users' own cost terms.
        compiled: The scene compiled earlier; any draw of its bodies will do.

    Raises:
        SceneError: If the engine cannot simulate the scene.
    """
    if scene.planner.samples is not SampleCount.AUTO:
        return scene
    where = "cpu" if device == "auto" else device
    file = cache_folder().parent / "samples" / f"{timing_key(scene, where, envs, terms)}-{engine}.json"
    kept = read_kept(file)
    if isinstance(kept, int) and FEWEST <= kept <= MOST:
        return with_samples(scene, kept)
    compiled = compiled or compile_scene(scene)

    def time(count: int) -> float:
        return plan_time(with_samples(scene, count), compiled, device, envs=envs, terms=terms, engine=engine)

    count, seconds = most_samples(time, SHARE * scene.timing.control_dt)
    keep(file, count)
    period = 1e3 * scene.timing.control_dt
    logger.info(
        "a plan of %d samples takes %.1f ms of the control's %g ms: taking as many", count, 1e3 * seconds, period
    )
    return with_samples(scene, count)


def fit_to_machine(
    scene: Scene, *, engine: str, device: str, envs: int = 1, terms: Sequence[UserTerm], compiled: CompiledScene | None
) -> tuple[int, str, str]:
    """Number of samples, engine and device for a scene here; arguments as for :func:`fit_samples`.

    Raises:
        SceneError: If the engine cannot simulate the scene, or a plan would take minutes.
        ValueError: If engine or device is unknown or not to be had here.
    """
    shared = {"envs": envs, "terms": terms}
    engine, device = choose_engine(scene, engine=engine, device=device, compiled=compiled, **shared)
    scene = fit_samples(scene, engine=engine, device=device, compiled=compiled, **shared)
    check_plan_time(scene, compiled, device, engine=engine, **shared)
    return scene.planner.samples, engine, device


def most_samples(time: Callable[[int], float], budget: float) -> tuple[int, float]:
    """The most samples, to a fifth, whose plans are within a budget, and how long they take.

    Args:
        time: Wall time of a plan with a number of samples [s].
        budget: How long a plan may take [s].
    """
    low, high = FEWEST, None
    taken = time(low)
    if taken > budget:
        return low, taken
    while high is None or high > 1.2 * low:
        # time grows no faster than the samples do; between bounds the middle
        ahead = 2 * low if high is None else (low + high) // 2
        count = min(ahead // 16 * 16, MOST)
        if count <= low:
            break
        seconds = time(count)
        if seconds > budget:
            high = count
        else:
            low, taken = count, seconds
    return low, taken
