# SPDX-License-Identifier: Apache-2.0
"""``engine = "auto"``: time one plan of each engine that this machine has, and take the faster."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..model.compiled import cache_folder
from ..scene.schema import EngineName

if TYPE_CHECKING:
    from ..cost.term import ArrayCost, CostTerm
    from ..model.compiled import CompiledScene
    from ..scene.schema import Scene

logger = logging.getLogger("warpmpc")

PLANS = 5
"""Timed plans per engine, of which the median counts."""


def fastest(
    scene: Scene, compiled: CompiledScene, device: str, *, envs: int, terms: Sequence[CostTerm | ArrayCost] = ()
) -> tuple[str, str]:
    """The faster engine and its device for a scene.

    What was measured is kept on disk by scene, batch and hardware, so that the next start measures nothing.

    Args:
        scene: The scene.
        compiled: The scene, compiled.
        device: CUDA device of the ``newton`` engine.
        envs: Number of environments.
        terms: Users' own cost terms.
    """
    choices = {str(EngineName.MUJOCO): "cpu", str(EngineName.NEWTON): device}
    file = cache_folder().parent / "engines" / f"{_key(scene, device, envs)}.json"
    times: dict[str, float] = {}
    with contextlib.suppress(OSError, ValueError, TypeError):
        times = {name: float(json.loads(file.read_text())[name]) for name in choices}
    if set(times) != set(choices):
        times = {n: _plan_time(scene, compiled, n, choices[n], envs=envs, terms=terms) for n in choices}
        with contextlib.suppress(OSError):
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(json.dumps(times))
    name = min(times, key=times.get)
    measured = ", ".join(f"{n} on {choices[n]} {1e3 * t:.1f} ms" for n, t in times.items())
    logger.info("one plan takes: %s; taking %s", measured, name)
    return name, choices[name]


def _plan_time(scene, compiled, name: str, device: str, *, envs: int, terms) -> float:
    """Median wall time [s] of a plan from the start state, compilation not counted."""
    from ..control.controller import Controller
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


def _key(scene: Scene, device: str, envs: int) -> str:
    """Hash of what a plan's time depends on."""
    import os
    import platform

    digest = hashlib.sha256()
    digest.update(scene.model_dump_json().encode())
    hardware = (
        f"{wp.get_device(device).name} {platform.processor()} {len(os.sched_getaffinity(0))} {envs} {wp.__version__}"
    )
    digest.update(hardware.encode())
    return digest.hexdigest()[:32]
