# SPDX-License-Identifier: Apache-2.0
"""Episodes in parallel worker processes, for tools that run many."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass

from warpmpc.scene.schema import EngineName

OMPL = "ompl"
PLANNER = "planner"


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
    method: str = PLANNER
    """Who drives: ``planner``, the scene's own, or ``ompl``, the geometric baseline."""


def check_engine(name: str) -> None:
    """Refuse an engine that does not exist before any process starts.

    Raises:
        ValueError: If there is no such engine.
    """
    if name not in list(EngineName):
        raise ValueError(f"--engine: no engine '{name}'; there is: {', '.join(EngineName)}")


def run_job(job: Job) -> dict:
    """Run one episode.

    Returns:
        ``result``, as :meth:`warpmpc.EpisodeResult.to_json` has it; ``measured``, as :meth:`measure.Meter.to_json`;
        and ``gpu``, the name of the GPU that planned, or None.

    Raises:
        SceneError: If the scene names anything that does not exist, or no task can be drawn.
        ValueError: If the engine or device is unknown or not to be had here.
    """
    from measure import Meter

    import warpmpc
    from warpmpc.run.episode import Episode

    scene = warpmpc.load_scene(job.scene, overrides=job.overrides)
    if job.method == OMPL:
        from baselines import run_geometric

        return run_geometric(scene, seed=job.seed)
    episode = Episode(scene, seed=job.seed, engine=job.engine, device=job.device)
    meter = Meter(episode.plant)
    result = episode.run(on_step=meter)
    return {"result": result.to_json(), "measured": meter.to_json(), "gpu": _gpu(result.device)}


def _gpu(device: str) -> str | None:
    if device == "cpu":
        return None
    import warp as wp

    return wp.get_device(device).name


class Workers:
    """Processes that run episodes; leaving the context ends them, whatever they are at.

    Args:
        count: Number of processes. Several run the rollouts on one thread each.
    """

    def __init__(self, count: int):
        self.count = count
        context = multiprocessing.get_context("spawn")  # physics libraries and their threads do not survive a fork
        self._pool = ProcessPoolExecutor(count, mp_context=context, initializer=_start)

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *error: object) -> None:
        # processes that have loaded physics take seconds to end by themselves
        self._pool.shutdown(wait=False, cancel_futures=True)
        for process in multiprocessing.active_children():
            process.terminate()

    def submit(self, job: Job) -> Future[dict]:
        """Queue an episode; the future holds what :func:`run_job` returns or raises."""
        if self.count > 1:
            job = Job(**{**vars(job), "overrides": (*job.overrides, "engine.threads=1")})
        return self._pool.submit(run_job, job)

    def call(self, function: Callable[..., dict], *arguments: object) -> Future[dict]:
        """Queue a call of a module's function; the future holds what it returns or raises."""
        return self._pool.submit(function, *arguments)


def _start() -> None:
    """Prepare a worker: it is silent, leaves Ctrl-C to its parent and does not outlive it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_follow_parent, daemon=True).start()
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)  # libraries chat on standard output, from native code, too
    logging.getLogger("warpmpc").setLevel(logging.ERROR)  # results count what is warned of
    from warpmpc.cli.run import start_warp

    start_warp()


def _follow_parent() -> None:
    """End this process when its parent has ended, however that came."""
    multiprocessing.parent_process().join()
    os._exit(1)
