# SPDX-License-Identifier: Apache-2.0
"""One episode of one of the suite's tasks: the suite's environment acts and rewards, warpmpc plans."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

import warpmpc
from warpmpc.cost.user_files import load_terms
from warpmpc.scene.model.compiled import compile_scene

from .environment import Eyes, load, save_model, step

FOLDER = Path(__file__).parent
WARM_UP = 2
"""Plans that are not timed: the first loads kernels, the second is recorded as a graph."""


@dataclass(frozen=True, kw_only=True)
class Episode:
    """What to play."""

    name: str
    """``domain_task``."""
    seed: int
    steps: int
    """Control steps; the suite's own episodes have 1000."""
    engine: str = "auto"
    overrides: tuple[str, ...] = ()
    """Changes of the scene, ``KEY=VALUE``."""
    settings: str = ""
    """Digest of what it is played with."""


@dataclass(frozen=True, kw_only=True)
class Played:
    """What came of it."""

    task: str
    seed: int
    steps: int
    reward: float
    """Sum over all steps, as the suite counts it."""
    engine: str
    samples: int
    horizon: float
    """[s]"""
    iterations: int
    control_ms: float
    """Control period [ms]."""
    plan_ms: dict[str, float]
    """Median and 99th percentile of a plan's wall time."""
    threads: int
    """Threads of the rollouts; 0 is one for each core."""
    fallbacks: int
    """Plans without a sample that survived."""
    settings: str
    """Digest of what it was played with."""


def names() -> list[str]:
    """All tasks there are scenes for, ``domain_task``."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def split(name: str) -> tuple[str, str]:
    """Domain and task: the suite writes some domains with underscores, too.

    Raises:
        ValueError: If there is no such task.
    """
    if name not in names():
        raise ValueError(f"no scene for the task '{name}'; there are: {', '.join(names())}")
    domain = next((d for d in ("ball_in_cup",) if name.startswith(f"{d}_")), name.partition("_")[0])
    return domain, name.removeprefix(f"{domain}_")


def scene_of(name: str, overrides: tuple[str, ...] = ()) -> warpmpc.Scene:
    """The scene to plan in: the task's file, with the environment's own model.

    Raises:
        ValueError: If there is no such task, or the suite is not installed.
        SceneError: If the scene or an override is wrong.
    """
    domain, task = split(name)
    model = save_model(domain, task)
    return warpmpc.load_scene(FOLDER / f"{name}.toml", overrides=[f'robot.{domain}.asset="{model}"', *overrides])


def settings_of(tasks: Sequence[str], overrides: Sequence[str], engine: str) -> str:
    """Digest of what episodes of some tasks are played with: scenes, terms, changes of the scenes and the engine."""
    files = [(FOLDER / name).read_text(encoding="utf-8") for name in ("terms.py", *(f"{task}.toml" for task in tasks))]
    return hashlib.sha256(json.dumps([files, list(overrides), engine]).encode()).hexdigest()[:12]


def work(name: str, scene: warpmpc.Scene) -> float:
    """A number that grows with the time of a plan: steps of all samples, times the square of the model's velocities."""
    planner = scene.planner
    velocities = load(*split(name), seed=0).physics.model.nv
    return planner.samples * planner.iterations * planner.horizon * velocities**2


def play(episode: Episode, *, on_step=None) -> dict:
    """Play one episode.

    Args:
        episode: What to play.
        on_step: Called with the environment and its time step after every control, for looking on.

    Returns:
        The fields of :class:`Played`.

    Raises:
        ValueError: If the scene does not fit the environment, or the engine is unknown.
    """
    domain, task = split(episode.name)
    scene = scene_of(episode.name, episode.overrides)
    environment = load(domain, task, seed=episode.seed)
    environment.reset()
    compiled = compile_scene(scene)
    eyes = Eyes(compiled, environment)
    dt = environment.control_timestep()
    if abs(dt - scene.timing.control_dt) > 1e-9:
        raise ValueError(f"{episode.name}: timing.control_dt is {scene.timing.control_dt}, the environment's {dt}")
    terms = load_terms([FOLDER / "terms.py"])
    mpc = warpmpc.Controller(
        scene, engine=episode.engine, device="cpu", seed=episode.seed, terms=terms, compiled=compiled
    )
    for target in scene.target:
        mpc.task[target.name] = eyes.place(target.name)
    reward, times, fallbacks = 0.0, [], 0
    for _ in range(episode.steps):
        seen = step(environment, mpc.step(eyes.state()))
        reward += seen.reward
        times.append(mpc.info.plan_ms)
        fallbacks += mpc.info.fallback
        if on_step:
            on_step(environment, seen)
        if seen.last():
            break
    return asdict(
        Played(
            task=episode.name,
            seed=episode.seed,
            steps=len(times),
            reward=reward,
            engine=mpc.engine.name,
            samples=scene.planner.samples,
            horizon=float(mpc.plan_step.grid.t[-1]),
            iterations=scene.planner.iterations,
            control_ms=1e3 * dt,
            plan_ms={name: float(np.percentile(times[WARM_UP:], q)) for name, q in (("p50", 50), ("p99", 99))},
            threads=scene.engine.threads,
            fallbacks=fallbacks,
            settings=episode.settings,
        )
    )
