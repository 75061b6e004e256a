# SPDX-License-Identifier: Apache-2.0
"""On which device plans of a scene take least time on this machine: time a few on each, once, and remember."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import platform
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..engine.registry import resolve
from ..model.compiled import cache_folder, compile_scene
from ..scene.errors import SceneError
from ..scene.schema import SampleCount
from .plan_budget import require_short_plans

if TYPE_CHECKING:
    from ..cost.term import UserTerm
    from ..model.compiled import CompiledScene
    from ..scene.schema import Scene

logger = logging.getLogger("warpmpc")

PLANS = 5
"""Timed plans per device, of which the median counts."""
USUAL = 256
"""Samples with which devices are compared for a scene that leaves their number to the machine."""


def choose_engine(
    scene: Scene,
    *,
    engine: str = "auto",
    device: str = "auto",
    envs: int = 1,
    terms: Sequence[UserTerm] = (),
    compiled: CompiledScene | None = None,
    measure: bool = False,
) -> tuple[str, str]:
    """Engine and device for a scene; with both left to ``auto``, GPU and CPU are compared by timing some plans.

    What was measured is kept on disk by scene (before any random draws), batch and hardware, so that the next start
    measures nothing.

    Args:
        scene: The scene, before its task is drawn.
        engine: ``auto`` or an engine's name.
        device: ``auto``, ``cpu`` or a CUDA device.
        envs: Number of environments.
        terms: Users' own cost terms.
        compiled: The scene compiled earlier; any draw of its bodies will do.
        measure: Whether plans are timed although the result of an earlier time is kept.

    Raises:
        SceneError: If no engine can simulate the scene.
        ValueError: If engine or device is unknown, not to be had here, or the two do not go together.
    """
    fixed = device != "auto"
    engine, where = resolve(scene, engine, device)
    if engine != "auto":
        return engine, where
    if fixed or where == "cpu":
        return engine, where
    choices = (where, "cpu")
    scene = with_samples(scene)
    file = cache_folder().parent / "engines" / f"{timing_key(scene, where, envs, terms)}.json"
    times: dict[str, float] = {}
    with contextlib.suppress(ValueError, TypeError):
        kept = {} if measure else read_kept(file) or {}
        times = {device: float(kept[device]) for device in choices if device in kept}
    if not times:
        compiled = compiled or compile_scene(scene)
        refused: list[SceneError] = []
        for device in choices:
            try:
                times[device] = plan_time(scene, compiled, device, envs=envs, terms=terms)
            except SceneError as error:  # no engine on this device can simulate the scene, on another one may
                refused.append(error)
        if not times:
            raise refused[0]
        keep(file, times)
    best = min(times, key=times.get)
    measured = ", ".join(f"{1e3 * t:.1f} ms on {device}" for device, t in times.items())
    logger.info("one plan takes: %s; taking %s", measured, best)
    return engine, best


def plan_time(scene: Scene, compiled: CompiledScene, device: str, **options: Any) -> float:
    """Median wall time [s] of a plan from the start state, compilation not counted.

    Raises:
        SceneError: If the engine cannot simulate the scene, or a plan would take minutes.
    """
    check_plan_time(scene, compiled, device, **options)
    return _timed(scene, compiled, device, **options)


def _timed(
    scene: Scene,
    compiled: CompiledScene,
    device: str,
    *,
    envs: int = 1,
    terms: Sequence[UserTerm] = (),
    engine: str = "auto",
) -> float:
    """Median wall time [s] of a plan, however long."""
    from ..controller.controller import Controller
    from ..model.state import State

    controller = Controller(scene, engine=engine, device=device, envs=envs, terms=terms, compiled=compiled)
    layout = compiled.layout
    state = State(np.tile(layout.joint_q, (envs, 1)), np.tile(layout.joint_qd, (envs, 1)))
    controller.step(state)
    times = []
    for _ in range(PLANS):
        start = time.perf_counter()
        controller.step(state)
        times.append(time.perf_counter() - start)
    controller.engine.close()
    return float(np.median(times))


def check_plan_time(
    scene: Scene, compiled: CompiledScene | None, device: str, *, envs: int = 1, **options: Any
) -> None:
    """Refuse a scene whose plans would take minutes here (:func:`require_short_plans`).

    Raises:
        SceneError: If they would.
    """

    def time(smaller: Scene) -> float:
        return _timed(smaller, compiled or compile_scene(scene), device, envs=envs, **options)

    require_short_plans(scene, time, envs=envs)


def with_samples(scene: Scene, count: int = USUAL) -> Scene:
    """A scene that leaves its number of samples to the machine with one; any other as it is."""
    if scene.planner.samples is not SampleCount.AUTO:
        return scene
    return scene.model_copy(update={"planner": scene.planner.model_copy(update={"samples": count})})


def read_kept(file: Path) -> object:
    """Read what :func:`keep` wrote; None where there is nothing."""
    with contextlib.suppress(OSError, ValueError):
        return json.loads(file.read_text())
    return None


def keep(file: Path, measured: object) -> None:
    """Keep what was measured for the next start, if it can be written."""
    with contextlib.suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(measured))


def timing_key(scene: Scene, device: str, envs: int, terms: Sequence[UserTerm]) -> str:
    """Hash of what a plan's time depends on."""
    digest = hashlib.sha256()
    digest.update(scene.model_dump_json().encode())
    digest.update(f"{_hardware(device)} {envs} {wp.__version__} {[term.name for term in terms]}".encode())
    return digest.hexdigest()[:32]


def _hardware(device: str) -> str:
    """Parts of this machine that a plan's time depends on."""
    return f"{wp.get_device(device).name} {platform.processor()} {len(os.sched_getaffinity(0))}"
