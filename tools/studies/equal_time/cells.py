# SPDX-License-Identifier: Apache-2.0
"""A strategy on a task: how many samples its plans have time for, and its episodes in closed loop."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cache
from typing import Protocol

import numpy as np
from shared.machine import machine

import warpmpc
from warpmpc.loop.run.workers import scene_digest

SINGLE = ("planner.iterations=1", "planner.execute=mean")
STRATEGIES = {
    "shipped": (),
    "samples": ("planner.refine=false",),
    "mppi": ("planner.method=mppi", "planner.refine=false", *SINGLE),
    "predictive_sampling": (
        *("planner.method=predictive_sampling", "planner.noise.source=halton", "planner.noise.null_sample=true"),
        *("planner.noise.spread=[0.02, 1.0]", "planner.noise.constant=0.1", *SINGLE),
    ),
    "tsallis": ("planner.method=tsallis", "planner.elites=10", *SINGLE),
    "cem": (
        *("planner.method=cem", "planner.iterations=3", "planner.elites=10", "planner.execute=mean"),
        *('planner.covariance={form="knots", restart=true}', "planner.noise.redraw=true"),
    ),
    "icem": (
        *("planner.method=icem", "planner.iterations=3", "planner.elites=10", "planner.execute=best"),
        *('planner.covariance={form="knots", restart=true}', "planner.noise.redraw=true", "planner.keep_best=3"),
        *("planner.decay=1.25", "planner.step_size=0.9", "planner.try_mean=last"),
        *("planner.noise.shape=coloured", "planner.noise.exponent=2.0", "planner.noise.null_sample=false"),
    ),
    "dial": (
        *("planner.method=dial", "planner.iterations=4", "planner.execute=mean", "planner.noise.redraw=true"),
        *("planner.noise.shape=identity", "planner.noise.anneal=[0.5, 2.0]"),
    ),
    "gradient_descent": ("planner.method=gradient_descent", "planner.samples=16", *SINGLE),
    "ilqg": ("planner.method=ilqg", "planner.samples=16", *SINGLE),
    "ilqs": ("planner.method=ilqs", *SINGLE),
}
"""What each strategy changes of a scene."""
SIZE = {"gradient_descent": "planner.refine.iterations", "ilqg": "planner.refine.iterations"}
"""What of a plan grows until it takes as long as it may; samples where nothing is said."""
MOST_ITERATIONS = 8
FEWEST, MOST = 16, 8192
"""Bounds of the number of samples."""
TRIAL_SECONDS, TRIAL_SEED = 6.0, 10000
"""How long an episode is whose plans are timed [s], since contacts make plans longer, and its seed, no other's."""


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A strategy on a task; with a seed, one of its episodes."""

    task: str
    strategy: str
    ms: float
    samples: int = FEWEST
    """Samples, or what else of :data:`SIZE` the strategy has."""
    seed: int = 0
    seconds: float = 0.0

    @property
    def scene(self) -> warpmpc.Scene:
        """The task's scene as the strategy plans it, on one thread."""
        size = f"{SIZE.get(self.strategy, 'planner.samples')}={self.samples}"
        own = (*STRATEGIES[self.strategy], size, "engine.threads=1")
        return warpmpc.load_scene(self.task, overrides=own)

    def key(self, what: str) -> str:
        """What tells the record of a fit or of a run from others'."""
        depends = figures_of(what, self.task, self.strategy, self.samples)
        return json.dumps([*asdict(self).values(), depends])


@cache
def figures_of(what: str, task: str, strategy: str, samples: int) -> str:
    """What figures depend on besides task, strategy and seed: scene, code's choice of figures and machine."""
    here = machine()
    scene = Cell(task=task, strategy=strategy, ms=1.0, samples=samples).scene
    return f"{what} {scene_digest(scene)} {here['cpu']} {here['cores']}"


def fit(cell: Cell) -> dict:
    """The number of samples whose plans take as long as the cell wants, in closed loop."""
    times: dict[int, float] = {}

    def seconds(samples: int) -> float:
        seconds = min(TRIAL_SECONDS, cell.scene.timing.timeout)
        times[samples] = 1e-3 * float(
            np.median(drive(replace(cell, samples=samples, seed=TRIAL_SEED, seconds=seconds))[1])
        )
        return times[samples]

    if cell.strategy in SIZE:
        samples = 1  # one round there must be, however long it takes
        while samples < MOST_ITERATIONS and (samples + 1) / samples * seconds(samples) < 1e-3 * cell.ms:
            samples += 1
    else:
        samples = count_for(seconds, 1e-3 * cell.ms)
    return {"samples": samples, "times_ms": {str(n): 1e3 * taken for n, taken in times.items()}}


def count_for(seconds: Callable[[int], float], budget: float, *, first: int = 64) -> int:
    """The number of samples whose plans take a time: between two that are measured, in proportion.

    Args:
        seconds: Wall time of a plan with a number of samples [s].
        budget: The time wanted [s].
        first: The number to begin with; it is doubled until plans take longer than wanted.
    """
    low, high = (FEWEST, seconds(FEWEST)), (first, seconds(first))
    while high[1] < budget and high[0] < MOST:
        low, high = high, (2 * high[0], seconds(2 * high[0]))
    share = (budget - low[1]) / max(high[1] - low[1], 1e-9)
    count = low[0] + float(np.clip(share, 0.0, 1.0)) * (high[0] - low[0])
    return max(16 * round(count / 16), FEWEST)  # whole registers


def run(cell: Cell) -> dict:
    """One episode in closed loop, to its end whatever is reached.

    Returns:
        ``cost``, the mean of the control steps, None where the plant diverged; ``reached``, when the goal was, None
        where it was not [s]; ``plan_ms``, the median.
    """
    costs, taken, reached = drive(cell)
    cost = float(np.mean(costs))
    return {"cost": cost if math.isfinite(cost) else None, "reached": reached, "plan_ms": float(np.median(taken))}


class Drive(Protocol):
    """An episode to drive: a strategy's on a task, or any other."""

    @property
    def scene(self) -> warpmpc.Scene:
        """The scene as it is planned."""

    @property
    def seed(self) -> int:
        """Seed of the episode."""

    @property
    def seconds(self) -> float:
        """How long it may take [s]."""


def drive(cell: Drive, *, to_the_end: bool = True) -> tuple[list[float], list[float], float | None]:
    """One episode in closed loop.

    Args:
        cell: What is driven, from which seed, how long at most.
        to_the_end: Whether it goes on although its goal was reached or it failed.

    Returns:
        The cost of every control step, infinite once the plant diverged; the wall time of every plan [ms]; and when
        the goal was reached [s].
    """
    from warpmpc.loop.run.episode import draws_bodies
    from warpmpc.scene.draw import draw_task
    from warpmpc.scene.model.compiled import compile_scene

    scene, _ = draw_task(cell.scene, cell.seed)
    compiled = compile_scene(scene, cache=not draws_bodies(scene))
    controller = warpmpc.Controller(scene, device="cpu", seed=cell.seed, compiled=compiled)
    task, labels = controller.task, scene.cost_labels
    plant = warpmpc.Plant(scene, seed=cell.seed, task=task, watch=labels, compiled=compiled)
    observation = plant.observe()
    for _ in range(2):  # loads kernels, then records them
        controller.step(observation)
    controller.reset()
    costs, taken, reached = [], [], None
    while plant.time < cell.seconds - 1e-9 and not plant.diverged:
        plant.apply(controller.step(observation))
        taken.append(controller.info.plan_ms)
        costs.append(sum(float(task[label]) * value for label, value in plant.terms.items()))
        if reached is None and plant.success:
            reached = plant.time
        if plant.done and not to_the_end:
            break
        observation = plant.observe()
    controller.engine.close()
    return [*costs, math.inf] if plant.diverged else costs, taken, reached
