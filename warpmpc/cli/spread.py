# SPDX-License-Identifier: Apache-2.0
"""Episodes of ``warpmpc run`` spread over processes, GPUs or a cluster."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import typer

from ..loop.run.ray_workers import DIED
from ..loop.run.workers import one_thread, open_workers
from ..scene.errors import SceneError
from ..scene.load import shipped_scenes
from ..scene.schema import SampleCount
from .outputs import Outputs
from .progress import BatchBar
from .setup import FAILURE, RunArguments, Setup, others_whole, user_errors
from .terminal import say

if TYPE_CHECKING:
    from ..loop.log.run_log import RunLog
    from ..loop.run.result import EpisodeResult
    from ..loop.run.workers import KeptResults


def portable(source: str, setup: Setup) -> str:
    """A scene's source that means the same in any folder."""
    path, variant = setup.scene.path, setup.scene.variant
    if path is None or shipped_scenes().get(path.stem) == path:
        return source
    return str(path) if variant is None else f"{path}:{variant}"


def run_seeds(arguments: RunArguments, seeds: Sequence[int], logs: bool) -> list[tuple[EpisodeResult, RunLog | None]]:
    """Run the episodes of some seeds, planned for together if there are several; returns results, and logs if wanted.

    Raises:
        SceneError: If the scene is wrong.
        ValueError: If engine or device is unknown or not available here, or a file of terms cannot be used.
    """
    setup = shared_setup(arguments)
    if len(seeds) > 1:
        return [(result, None) for result in setup.batch(seeds, len(seeds)).run()]
    episode = setup.episode(seeds[0])
    if not logs:
        return [(episode.run(), None)]
    from ..loop.run.run_recorder import RunRecorder

    recorder = RunRecorder(episode.plant, episode.controller)
    return [(episode.run(recorder=recorder), recorder.run_log)]


@lru_cache(maxsize=1)
def shared_setup(arguments: RunArguments) -> Setup:
    """A scene with everything that the episodes of a process share."""
    return Setup(arguments)


def shares(seeds: Sequence[int], envs: int, workers: int) -> list[Sequence[int]]:
    """Seeds of the episodes of each job: as many as its part of all environments."""
    size = -(-min(envs, len(seeds)) // min(workers, envs))
    return [seeds[first : first + size] for first in range(0, len(seeds), size)]


def run_spread(
    arguments: RunArguments,
    setup: Setup,
    seeds: Sequence[int],
    envs: int,
    *,
    jobs: str,
    outputs: Outputs,
    kept: KeptResults | None,
    shown: bool,
) -> Iterator[EpisodeResult]:
    """Run one episode per seed at some place, ``envs`` environments in all at once, those of a job planned together.

    Yields:
        Kept results, then those of episodes as they end.
    """
    with BatchBar(len(seeds), shown=shown) as bar:
        with user_errors():
            if setup.scene.planner.samples is SampleCount.AUTO:
                raise SceneError(
                    "is measured, which parallel jobs would disturb: give a number, or leave out --jobs",
                    key="planner.samples",
                    file=setup.scene.path,
                    found="auto",
                )
            workers, device = open_workers(jobs, device=setup.device)
        with workers:
            todo: list[Sequence[int]] = []
            for share in shares(seeds, envs, workers.count):
                found = kept.find(share) if kept else []
                yield from found
                for result in found:
                    bar.finish(result)
                if not found:
                    todo.append(share)
            arguments = replace(
                arguments,
                source=portable(arguments.source, setup),
                overrides=tuple(one_thread(workers, arguments.overrides)),
                term_files=tuple(path.absolute() for path in arguments.term_files),
                device=device,
            )
            futures = {workers.submit(run_seeds, arguments, share, outputs.logs): share for share in todo}
            bar.advance()
            for future in as_completed(futures):
                for result, log in _outcome(future):
                    if log is not None:
                        outputs.save(log, result.seed, result)
                    if kept:
                        with others_whole():
                            kept.add(futures[future], result)
                    bar.finish(result)
                    bar.advance()
                    yield result


def _outcome(future: Future) -> list[tuple[EpisodeResult, RunLog | None]]:
    """Return the results of a job, or end the command."""
    try:
        with user_errors():
            return future.result()
    except BrokenProcessPool:
        say(f"error: {DIED}", out=sys.stderr)
        raise typer.Exit(FAILURE) from None
