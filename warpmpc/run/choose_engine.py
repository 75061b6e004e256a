# SPDX-License-Identifier: Apache-2.0
"""Which engine plans a scene fastest on this machine: time one plan of each, once, and remember."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import platform
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..engine.registry import ENGINES, resolve
from ..model.compiled import cache_folder, compile_scene
from ..scene.errors import SceneError

if TYPE_CHECKING:
    from ..cost.term import ArrayCost, CostTerm
    from ..model.compiled import CompiledScene
    from ..scene.schema import Scene

logger = logging.getLogger("warpmpc")

PLANS = 5
"""Timed plans per engine, of which the median counts."""


def choose_engine(
    scene: Scene,
    *,
    engine: str = "auto",
    device: str = "auto",
    envs: int = 1,
    terms: Sequence[CostTerm | ArrayCost] = (),
    compiled: CompiledScene | None = None,
) -> tuple[str, str]:
    """Engine and device for a scene; where there is a choice, the faster one is found by timing a few plans of each.

    What was measured is kept on disk by scene (before any random draws), batch and hardware, so that the next start
    measures nothing.

    Args:
        scene: The scene, before its task is drawn.
        engine: ``auto`` or an engine's name.
        device: ``auto``, ``cpu`` or a CUDA device.
        envs: Number of environments.
        terms: Users' own cost terms.
        compiled: The scene compiled earlier; any draw of its bodies will do.

    Raises:
        SceneError: If no engine can simulate the scene.
        ValueError: If engine or device is unknown, not to be had here, or the two do not go together.
    """
    engine, device = resolve(scene, engine, device)
    if engine != "auto":
        return engine, device
    choices = {name: device if entry.cuda else "cpu" for name, entry in ENGINES.items() if entry.physics}
    file = cache_folder().parent / "engines" / f"{_key(scene, device, envs, terms)}.json"
    times: dict[str, float] = {}
    with contextlib.suppress(OSError, ValueError, TypeError, KeyError):
        kept = json.loads(file.read_text())
        times = {name: float(kept[name]) for name in choices if name in kept}
    if not times:
        compiled = compiled or compile_scene(scene)
        refused: list[SceneError] = []
        for n in choices:
            try:
                times[n] = _plan_time(scene, compiled, n, choices[n], envs=envs, terms=terms)
            except SceneError as error:  # this engine cannot simulate the scene, another may
                refused.append(error)
        if not times:
            raise refused[0]
        with contextlib.suppress(OSError):
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(json.dumps(times))
    name = min(times, key=times.get)
    measured = ", ".join(f"{n} on {choices[n]} {1e3 * t:.1f} ms" for n, t in times.items())
    logger.info("one plan takes: %s; taking %s", measured, name)
    return name, choices[name]


def _plan_time(
    scene: Scene,
    compiled: CompiledScene,
    name: str,
    device: str,
    *,
    envs: int,
    terms: Sequence[CostTerm | ArrayCost],
) -> float:
    """Median wall time [s] of a plan from the start state, compilation not counted."""
    from ..controller.controller import Controller
    from ..model.state import State

    controller = Controller(scene, engine=name, device=device, envs=envs, terms=terms, compiled=compiled)
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


def _key(scene: Scene, device: str, envs: int, terms: Sequence[CostTerm | ArrayCost]) -> str:
    """Hash of what a plan's time depends on."""
    digest = hashlib.sha256()
    digest.update(scene.model_dump_json().encode())
    hardware = f"{wp.get_device(device).name} {platform.processor()} {len(os.sched_getaffinity(0))}"
    digest.update(f"{hardware} {envs} {wp.__version__} {[term.name for term in terms]}".encode())
    return digest.hexdigest()[:32]
