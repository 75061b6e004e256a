# SPDX-License-Identifier: Apache-2.0
"""How a row of the table of goals is measured."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import warp as wp
from shared.plan_times import bare_physics, batched, time_plans

import warpmpc
from benches.physics import physics, physics_on_device
from warpmpc.engine.mujoco import silence_mujoco
from warpmpc.scene.model.compiled import compile_scene

from .rows import CORE, MOST_WORLDS, PLAN, WARP, Row

SKIPPED = 10
"""Plans at the start of a run that do not count."""
STATES = 12
"""States of the run that the floor is measured from."""
SMALL = ("planner.samples=16", "planner.horizon=4")
"""Sizes that only show that everything runs."""


def measure(row: Row, *, plans: int, floor: bool, small: bool, seconds: float) -> Iterator[dict]:
    """Measure a row, and yield every part of its figures as soon as it is there.

    Args:
        row: The row.
        plans: Timed plans.
        floor: Whether to measure the floor, too.
        small: Whether to take tiny sizes instead of the row's.
        seconds: Time there is for everything.
    """
    silence_mujoco()
    if small:
        yield {"goal": None}
    end = time.perf_counter() + seconds
    if row.kind == PLAN:
        yield from _plan(row, plans=plans, floor=floor, small=small, end=end)
        return
    try:
        if row.kind == CORE:
            yield physics(row.scene, 16 if small else 512, steps=5 if small else 50, runs=2 if small else 7)
        elif row.kind == WARP:
            sizes = {"steps": 2 if small else 50, "runs": 1 if small else 7}
            device = str(wp.get_preferred_device())
            yield physics_on_device(row.scene, 16 if small else MOST_WORLDS, device=device, **sizes)
    except ValueError as error:
        yield {"error": str(error)}


def _plan(row: Row, *, plans: int, floor: bool, small: bool, end: float) -> Iterator[dict]:
    """Whole plans in closed loop, then other engines' plans and the physics alone from states of the same run."""
    overrides = [*row.overrides, *(SMALL if small else ())]
    envs = min(row.envs, 2) if small else row.envs
    scene = warpmpc.load_scene(row.scene, overrides=overrides)
    compiled = compile_scene(scene)
    device = str(wp.get_preferred_device()) if row.cores is None else "cpu"
    begin = time.perf_counter()
    controller = warpmpc.Controller(scene, engine="fused", device=device, seed=0, compiled=compiled)
    plant = warpmpc.Plant(scene, compiled=compiled, task=controller.task)
    states, times = [], []
    for i in range(plans + SKIPPED):
        states.append(plant.observe())
        start = time.perf_counter()
        control = controller.step(states[-1])
        times.append(1e3 * (time.perf_counter() - start))
        if i == 0:
            yield {"device": wp.get_device(device).name, "first_plan_s": time.perf_counter() - begin}
        if plant.done or (len(times) > SKIPPED + 5 and time.perf_counter() > end - 5.0):
            break
        plant.apply(control)
    controller.engine.close()
    some = [states[k] for k in np.linspace(0, len(states) - 1, STATES).round().astype(int)]
    if envs > 1:
        controller = warpmpc.Controller(scene, engine="fused", device=device, seed=0, envs=envs, compiled=compiled)
        times, _ = time_plans(controller, batched(some, envs), plans=plans, seconds=(end - time.perf_counter()) / 3)
        controller.engine.close()
    else:
        times = times[min(SKIPPED, len(times) // 2) :]
    yield _percentiles("plan_ms", times) | {"plans": len(times)}
    if not floor:
        return
    other = "mujoco_warp" if row.cores is None else "mujoco"
    controller = warpmpc.Controller(scene, engine=other, device=device, seed=0, envs=envs, compiled=compiled)
    turns = batched(some, envs)
    for state in turns[:2]:
        controller.step(state)  # compiles, captures
    bare = bare_physics(controller)
    left = max(1.0, min(10.0, end - 3.0 - time.perf_counter()))
    whole, alone = time_plans(controller, turns, plans=plans, seconds=left, bare=bare)
    controller.engine.close()
    yield _percentiles("other_plan_ms", whole) | _percentiles("floor_ms", alone) | {"other": other}


def _percentiles(key: str, times: list[float]) -> dict:
    return {key: {f"p{p}": float(np.percentile(times, p)) for p in (50, 99)}}
