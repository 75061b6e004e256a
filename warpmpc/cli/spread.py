# SPDX-License-Identifier: Apache-2.0
"""Episodes of ``warpmpc run`` spread over processes, GPUs or a cluster."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, as_completed
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from ..run.workers import LostJob, one_thread, open_workers
from ..scene.errors import SceneError
from ..scene.load import shipped_scenes
from ..scene.schema import SampleCount
from .outputs import Outputs
from .progress import BatchBar
from .setup import FAILURE, Setup, user_errors

if TYPE_CHECKING:
    from ..record.history import History
    from ..run.episode import EpisodeResult
    from ..run.kept import KeptResults


@dataclass(frozen=True, kw_only=True)
class Order:
    """What a worker must know of the episodes it runs."""

    source: str
    overrides: tuple[str, ...]
    term_files: tuple[Path, ...]
    engine: str
    device: str
    histories: bool
    """Whether histories are wanted."""


def portable(source: str, setup: Setup) -> str:
    """A scene's source that means the same in any folder."""
    path, variant = setup.scene.path, setup.scene.variant
    if path is None or shipped_scenes().get(path.stem) == path:
        return source
    return str(path) if variant is None else f"{path}:{variant}"


def run_seeds(order: Order, seeds: Sequence[int]) -> list[tuple[EpisodeResult, History | None]]:
    """Run the episodes of some seeds, planned for together if there are several; returns their results.

    Raises:
        SceneError: If the scene is wrong.
        ValueError: If engine or device is unknown or not to be had here, or a file of terms cannot be used.
    """
    setup = _setup(order)
    if len(seeds) > 1:
        return [(result, None) for result in setup.batch(seeds, len(seeds)).run()]
    episode = setup.episode(seeds[0])
    if not order.histories:
        return [(episode.run(), None)]
    from ..record.history import HistoryRecorder

    recorder = HistoryRecorder(episode.controller, episode.plant)
    return [(episode.run(recorder=recorder), recorder.history)]


@lru_cache(maxsize=1)
def _setup(order: Order) -> Setup:
    """A scene with everything that the episodes of a process share."""
    return Setup(
        order.source,
        overrides=order.overrides,
        term_files=order.term_files,
        engine=order.engine,
        device=order.device,
    )


def shares(seeds: Sequence[int], envs: int, workers: int) -> list[Sequence[int]]:
    """Seeds of the episodes of each job: as many as its part of all environments."""
    size = -(-min(envs, len(seeds)) // min(workers, envs))
    return [seeds[first : first + size] for first in range(0, len(seeds), size)]


def run_spread(
    source: str,
    setup: Setup,
    seeds: Sequence[int],
    envs: int,
    *,
    jobs: str,
    overrides: Sequence[str],
    term_files: Sequence[Path],
    outputs: Outputs,
    kept: KeptResults | None,
    shown: bool,
) -> Iterator[EpisodeResult]:
    """Run one episode per seed at some place, ``envs`` environments in all at once, those of a job planned together.

    Args:
        source: Scene and variant.
        setup: The same, built here.
        seeds: Seeds of the episodes.
        envs: Environments of all jobs together.
        jobs: The place, as for :func:`~warpmpc.run.workers.open_workers`.
        overrides: ``KEY=VALUE`` texts.
        term_files: Python files of cost terms.
        outputs: Files to write.
        kept: Results that are there already, and where new ones go.
        shown: Whether to show a bar.

    Yields:
        Kept results, then those of episodes as they end.
    """
    with BatchBar(len(seeds), shown=shown) as bar:
        with user_errors():
            if setup.scene.planner.samples is SampleCount.AUTO:
                raise SceneError(
                    "is measured, which jobs beside each other would disturb: give a number, or leave out --jobs",
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
            order = Order(
                source=portable(source, setup),
                overrides=one_thread(workers, overrides),
                term_files=tuple(path.absolute() for path in term_files),
                engine=setup.engine,
                device=device,
                histories=outputs.histories,
            )
            futures = {workers.submit(run_seeds, order, share): share for share in todo}
            bar.advance()
            for future in as_completed(futures):
                for result, history in _outcome(future):
                    if history is not None:
                        with user_errors():
                            outputs.save(history, result.seed)
                    if kept:
                        kept.add(futures[future], result)
                    bar.finish(result)
                    bar.advance()
                    yield result


def _outcome(future: Future) -> list[tuple[EpisodeResult, History | None]]:
    """What a job returned, or the end of the command."""
    try:
        with user_errors():
            return future.result()
    except LostJob as error:
        print(f"error: {error}", file=sys.stderr)
        raise typer.Exit(FAILURE) from None
