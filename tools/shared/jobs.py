# SPDX-License-Identifier: Apache-2.0
"""Episodes for workers, for tools that run many."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import dataclass, replace

from warpmpc.loop.run.workers import Workers, one_thread
from warpmpc.scene.schema import EngineName


@dataclass(frozen=True, kw_only=True)
class Job:
    """One episode to run."""

    scene: str
    """Scene, with or without a variant, or a scene file."""
    seed: int
    overrides: tuple[str, ...] = ()
    """Changes of the scene, ``KEY=VALUE``."""
    engine: str = "auto"
    device: str = "auto"


def check_engine(name: str) -> None:
    """Refuse an engine that does not exist before any process starts.

    Raises:
        ValueError: If there is no such engine.
    """
    if name not in EngineName.names():
        raise ValueError(f"--engine: no engine '{name}'; there is: {', '.join(EngineName.names())}")


def run_job(job: Job) -> dict:
    """Run one episode.

    Returns:
        ``result``, as :meth:`warpmpc.EpisodeResult.to_json` has it; ``measured``, as :meth:`Meter.to_json`;
        and ``gpu``, the name of the GPU that planned, or None.

    Raises:
        SceneError: If the scene names anything that does not exist, or no task can be drawn.
        ValueError: If the engine or device is unknown or not to be had here.
    """
    import warpmpc
    from shared.measure import Meter
    from warpmpc.loop.run.episode import Episode

    scene = warpmpc.load_scene(job.scene, overrides=job.overrides)
    episode = Episode(scene, seed=job.seed, engine=job.engine, device=job.device)
    meter = Meter(episode.plant)
    result = episode.run(on_step=meter)
    return {"result": result.to_json(), "measured": meter.to_json(), "gpu": _gpu(result.device)}


def _gpu(device: str) -> str | None:
    if device == "cpu":
        return None
    import warp as wp

    return wp.get_device(device).name


def submit(workers: Workers, job: Job) -> Future[dict]:
    """Queue an episode; the future holds what :func:`run_job` returns or raises. Several take one thread each."""
    return workers.submit(run_job, replace(job, overrides=one_thread(workers, job.overrides)))
