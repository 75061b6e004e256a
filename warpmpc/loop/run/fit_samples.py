# SPDX-License-Identifier: Apache-2.0
"""What is left to the machine: the device on which plans take least time, and as many samples as fit into a control."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import math
import os
import platform
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ...engine.registry import resolve
from ...scene.check import farthest, plan_sizes
from ...scene.errors import SceneError
from ...scene.model.compiled import cache_folder, compile_scene
from ...scene.schema import SampleCount

if TYPE_CHECKING:
    from ...cost.term import UserTerm
    from ...scene.model.compiled import CompiledScene
    from ...scene.schema import Scene

logger = logging.getLogger("warpmpc")

PLANS = 5
"""Timed plans, of which the median counts."""
USUAL = 256
"""Samples with which devices are compared for a scene that leaves their number to the machine."""
FEWEST, MOST = 32, 8192
"""Bounds of the samples that are chosen."""
SHARE = 0.6
"""Share of a control that plans may take: what else a robot does, and plans that take longer than others."""
LARGE = 2_000_000
"""Steps of all rollouts of a plan from which it may take minutes on a CPU."""


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
        ValueError: If engine or device is unknown, not available here, or the two do not go together.
    """
    fixed = device != "auto"
    engine, where = resolve(scene, engine, device)
    if engine != "auto" or fixed or where == "cpu":
        return engine, where
    scene = with_samples(scene)
    file = cache_folder().parent / "engines" / f"{timing_key(scene, where, envs, terms)}.json"
    kept = {} if measure else read_kept(file)
    times = {choice: kept[choice] for choice in (where, "cpu") if isinstance(kept.get(choice), float)}
    if not times:
        compiled = compiled or compile_scene(scene)
        refused: list[SceneError] = []
        for choice in (where, "cpu"):
            try:
                times[choice] = plan_time(scene, compiled, choice, envs=envs, terms=terms)
            except SceneError as error:  # no engine on this device can simulate the scene, on another one may
                refused.append(error)
        if not times:
            raise refused[0]
        keep(file, times)
    best = min(times, key=times.get)
    measured = ", ".join(f"{1e3 * t:.1f} ms on {device}" for device, t in times.items())
    logger.info("one plan takes: %s; taking %s", measured, best)
    return engine, best


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
    kept, when = {} if measure else read_kept(file), "now"
    if kept.keys() == {"samples", "plan_ms", "when"} and kept["samples"] in range(FEWEST, MOST + 1):
        when = f"on {kept['when']}"
    else:
        compiled = compiled or compile_scene(scene)

        def time_of(count: int) -> float:
            return plan_time(with_samples(scene, count), compiled, device, envs=envs, terms=terms, engine=engine)

        count, seconds = most_samples(time_of, SHARE * scene.timing.control_dt)
        kept = {"samples": count, "plan_ms": 1e3 * seconds, "when": time.strftime("%Y-%m-%d")}
        keep(file, kept)
    logger.info(
        "planner.samples = %d: their plan takes %.1f ms of the control's %g ms, measured %s%s",
        *(kept["samples"], kept["plan_ms"], 1e3 * scene.timing.control_dt, when),
        "" if when == "now" else " (warpmpc check --measure does it again)",
    )
    return with_samples(scene, kept["samples"])


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

    The log has a warning where a plan may take minutes.

    Raises:
        SceneError: If the engine cannot simulate the scene.
        ValueError: If engine or device is unknown or not available here.
    """
    shared = {"envs": envs, "terms": terms, "compiled": compiled, "measure": measure}
    engine, device = choose_engine(scene, engine=engine, device=device, **shared)
    scene = fit_samples(scene, engine=engine, device=device, **shared)
    sizes = plan_sizes(scene)
    steps = envs * math.prod(sizes.values())
    if steps > LARGE and device == "cpu":
        name = farthest(sizes)
        text = "planner.%s = %d: a plan has %.2g steps of rollouts and may take minutes: lower this, or take a GPU"
        logger.warning(text, name, sizes[name], steps)
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


def plan_time(
    scene: Scene,
    compiled: CompiledScene,
    device: str,
    *,
    envs: int = 1,
    terms: Sequence[UserTerm] = (),
    engine: str = "auto",
) -> float:
    """Median wall time [s] of a plan from the start state, compilation not counted.

    Raises:
        SceneError: If the engine cannot simulate the scene.
    """
    from ...planner.controller.controller import Controller
    from ...scene.model.state import State

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


def with_samples(scene: Scene, count: int = USUAL) -> Scene:
    """A scene that leaves its number of samples to the machine with one; any other as it is."""
    if scene.planner.samples is not SampleCount.AUTO:
        return scene
    return scene.model_copy(update={"planner": scene.planner.model_copy(update={"samples": count})})


def read_kept(file: Path) -> dict[str, Any]:
    """Read what :func:`keep` wrote; nothing where it is damaged."""
    with contextlib.suppress(OSError, ValueError):
        kept = json.loads(file.read_text())
        return kept if isinstance(kept, dict) else {}
    return {}


def keep(file: Path, measured: dict[str, Any]) -> None:
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
