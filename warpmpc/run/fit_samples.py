# SPDX-License-Identifier: Apache-2.0
"""As many samples as fit into a control on this machine, for scenes that leave their number open."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from ..model.compiled import cache_folder, compile_scene
from ..scene.schema import SampleCount
from .choose_engine import check_plan_time, choose_engine, keep, plan_time, read_kept, timing_key, with_samples
from .machine_load import BUSY, Waiting

if TYPE_CHECKING:
    from pathlib import Path

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
    measure: bool = False,
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
        measure: Whether plans are timed although the result of an earlier time is kept.

    Raises:
        SceneError: If the engine cannot simulate the scene.
    """
    if scene.planner.samples is not SampleCount.AUTO:
        return scene
    where = "cpu" if device == "auto" else device
    file = cache_folder().parent / "samples" / f"{timing_key(scene, where, envs, terms)}-{engine}.json"
    kept = None if measure else _kept(file)
    if kept is None:
        compiled, waiting = compiled or compile_scene(scene), Waiting()

        def time_of(count: int) -> float:
            return plan_time(with_samples(scene, count), compiled, device, envs=envs, terms=terms, engine=engine)

        count, seconds = most_samples(time_of, SHARE * scene.timing.control_dt)
        today = time.strftime("%Y-%m-%d")
        kept = {"samples": count, "plan_ms": 1e3 * seconds, "when": today, "waited": waiting.share}
        keep(file, kept)
        when = "now"
    else:
        when = f"on {kept['when']}"
    period = 1e3 * scene.timing.control_dt
    logger.info(
        "planner.samples = %d: their plan takes %.1f ms of the control's %g ms, measured %s%s",
        *(kept["samples"], kept["plan_ms"], period, when),
        "" if when == "now" else " (warpmpc check --measure does it again)",
    )
    if kept["waited"] > BUSY:
        logger.warning(
            "planner.samples was measured while others used this machine, its threads waited %.0f %% of the time: "
            "more may fit; warpmpc check --measure measures again",
            100.0 * kept["waited"],
        )
    return with_samples(scene, kept["samples"])


def _kept(file: Path) -> dict[str, Any] | None:
    """Result of an earlier measurement; None where it is not known."""
    kept = read_kept(file)
    if not isinstance(kept, dict) or kept.keys() != {"samples", "plan_ms", "when", "waited"}:
        return None
    return kept if isinstance(kept["samples"], int) and FEWEST <= kept["samples"] <= MOST else None


def fit_to_machine(
    scene: Scene,
    *,
    engine: str,
    device: str,
    envs: int = 1,
    terms: Sequence[UserTerm],
    compiled: CompiledScene | None,
    measure: bool = False,
) -> tuple[int, str, str]:
    """Number of samples, engine and device for a scene here; arguments as for :func:`fit_samples`.

    Raises:
        SceneError: If the engine cannot simulate the scene, or a plan would take minutes.
        ValueError: If engine or device is unknown or not to be had here.
    """
    shared = {"envs": envs, "terms": terms}
    engine, device = choose_engine(scene, engine=engine, device=device, compiled=compiled, measure=measure, **shared)
    scene = fit_samples(scene, engine=engine, device=device, compiled=compiled, measure=measure, **shared)
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
