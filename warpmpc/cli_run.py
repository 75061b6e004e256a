# SPDX-License-Identifier: Apache-2.0
"""What ``warpmpc check`` and ``warpmpc run`` do: build, run, show progress, report, and fail with one message."""

from __future__ import annotations

import json
import logging
import os
import sys
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

import typer

from .cli_terms import load_terms
from .scene.errors import SceneError
from .scene.load import load_scene
from .scene.schema import EngineName

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    import numpy as np
    from rich.console import Console

    from .controller import Controller
    from .cost.term import ArrayCost, CostTerm
    from .engine.compiled import CompiledScene
    from .episode import Episode, EpisodeResult
    from .plant import Plant
    from .scene.schema import Scene

SUCCESS, FAILURE, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
"""Exit codes."""


@contextmanager
def user_errors() -> Iterator[None]:
    """Turn wrong input into one message on stderr and exit code 2."""
    try:
        yield
    except (SceneError, ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        raise typer.Exit(BAD_INPUT) from None


@contextmanager
def results_only() -> Iterator[TextIO]:
    """The real standard output, as a file; meanwhile whatever else is printed there goes to stderr."""
    sys.stdout.flush()
    real = os.dup(1)
    os.dup2(2, 1)
    with open(os.dup(real), "w", encoding="utf-8") as out:
        try:
            yield out
        finally:
            out.flush()
            sys.stdout.flush()
            os.dup2(real, 1)
            os.close(real)


def start_warp() -> None:
    """Start Warp without its banner, its reports of loaded modules and its complaint about a missing GPU."""
    import warp as wp

    logging.getLogger("newton").setLevel(logging.WARNING)

    wp.config.log_level = wp.LOG_WARNING
    sys.stderr.flush()
    real = os.dup(2)
    with tempfile.TemporaryFile() as said:
        os.dup2(said.fileno(), 2)  # the complaint comes from native code
        try:
            wp.init()
        except BaseException:
            said.seek(0)
            os.write(real, said.read())
            raise
        finally:
            os.dup2(real, 2)
            os.close(real)


class Setup:
    """A scene with everything that its episodes share.

    Args:
        source: Scene and variant.
        overrides: ``KEY=VALUE`` texts.
        term_files: Python files of cost terms.
        engine: Engine of the rollouts.
        device: Device of the rollouts.

    Raises:
        SceneError: If the scene is wrong.
        ValueError: If engine or device is unknown, or a file of terms cannot be used.
    """

    def __init__(self, source: str, *, overrides: Sequence[str], term_files: Sequence[Path], engine: str, device: str):
        self.engine, self.device = engine, device
        self.scene: Scene = load_scene(source, overrides=overrides)
        if engine not in list(EngineName):
            raise ValueError(f"--engine: no engine '{engine}'; there is: {', '.join(EngineName)}")
        start_warp()
        from .episode import compile_shared

        self.compiled: CompiledScene | None = compile_shared(self.scene)
        self.terms: list[CostTerm | ArrayCost] = load_terms(term_files)

    def episode(self, seed: int) -> Episode:
        """The episode of a seed, ready to run."""
        from .episode import Episode

        return Episode(
            self.scene,
            seed=seed,
            engine=self.engine,
            device=self.device,
            terms=self.terms,
            compiled=self.compiled,
        )


def check(
    source: str, *, overrides: Sequence[str], term_files: Sequence[Path], seed: int, engine: str, device: str
) -> int:
    """Build what a run of the scene would, make one plan and show what was built; returns the exit code."""
    with results_only() as out:
        with user_errors():
            setup = Setup(source, overrides=overrides, term_files=term_files, engine=engine, device=device)
            episode = setup.episode(seed)
        observation = episode.plant.observe()
        for _ in range(2):  # the first plan compiles kernels
            episode.controller.step(observation)

        from .report import print_check

        print_check(episode, out)
    return SUCCESS


def run(
    source: str,
    *,
    seeds: Sequence[int],
    overrides: Sequence[str],
    term_files: Sequence[Path],
    engine: str,
    device: str,
    record: Path | None,
    json_lines: bool,
    quiet: bool,
) -> int:
    """Run one episode per seed, report, and return the exit code."""
    results: list[EpisodeResult] = []
    interrupted = False
    with results_only() as out:
        try:
            with user_errors():
                if record is not None and not record.absolute().parent.is_dir():
                    raise ValueError(f"--record: no such folder: {record.absolute().parent}")
                setup = Setup(source, overrides=overrides, term_files=term_files, engine=engine, device=device)
            with Progress(setup.scene, seeds, shown=not quiet) as progress:
                for seed in seeds:
                    result = _run_one(setup, seed, _record_path(record, seed, len(seeds)), progress)
                    interrupted = result.reason == "interrupted"
                    results.append(result)
                    if json_lines:
                        print(json.dumps(result.to_json(), ensure_ascii=False, allow_nan=False), file=out, flush=True)
                    if interrupted:
                        break
        except KeyboardInterrupt:
            interrupted = True
        if results and not json_lines and not quiet:
            from .report import print_results

            print_results(results, out)
    if interrupted:
        return INTERRUPTED
    return SUCCESS if all(result.success for result in results) else FAILURE


def _run_one(setup: Setup, seed: int, path: Path | None, progress: Progress) -> EpisodeResult:
    """Run the episode of one seed, to its end or to Ctrl-C."""
    from .episode import EpisodeInterrupted

    with user_errors():
        episode = setup.episode(seed)
        recorder = None
        if path is not None:
            from .record import Recorder  # slow to import

            recorder = Recorder(path, episode.controller, episode.plant)
    progress.start(seed)
    try:
        return episode.run(recorder=recorder, on_step=progress.step if progress.console else None)
    except EpisodeInterrupted as error:
        return error.result


def _record_path(record: Path | None, seed: int, episodes: int) -> Path | None:
    """File of one episode's recording: of several, each has its seed in its name."""
    return record.with_stem(f"{record.stem}-{seed}") if record is not None and episodes > 1 else record


class Progress:
    """A bar on stderr with the numbers of the last plan, and at most one warning per episode.

    Args:
        scene: The scene.
        seeds: Seeds of the episodes.
        shown: Whether to show anything.
    """

    PERIOD = 0.1
    """Time between updates [s]; the bar is drawn between plans, never during one."""

    def __init__(self, scene: Scene, seeds: Sequence[int], *, shown: bool):
        self.scene, self.seeds, self.shown = scene, seeds, shown
        self.console: Console | None = None
        self._next = 0.0
        self._handler = _FirstWarning(shown)

    def __enter__(self) -> Progress:
        logging.getLogger("warpmpc").addHandler(self._handler)
        if not self.shown or not sys.stderr.isatty():
            return self
        from rich.console import Console
        from rich.progress import BarColumn, TextColumn
        from rich.progress import Progress as Bar

        self.console = Console(stderr=True)
        self._bar = Bar(
            TextColumn("{task.description}"),
            BarColumn(bar_width=10 if self.console.width < 100 else 24),
            TextColumn("{task.fields[numbers]}"),
            console=self.console,
            auto_refresh=False,
            transient=True,
        )
        self._bar.start()
        self._task = self._bar.add_task("", total=self.scene.timing.timeout, numbers="building")
        return self

    def __exit__(self, *error: object) -> None:
        if self.console:
            self._bar.stop()
        logging.getLogger("warpmpc").removeHandler(self._handler)

    def start(self, seed: int) -> None:
        """A new episode begins."""
        self._handler.said = False
        if self.console:
            count = f" ({seed - self.seeds[0] + 1}/{len(self.seeds)})" if len(self.seeds) > 1 else ""
            self._bar.reset(self._task, description=f"seed {seed}{count}", numbers="first plan")
            self._bar.refresh()

    def step(self, controller: Controller, plant: Plant, control: np.ndarray) -> None:
        """An episode's ``on_step``."""
        if not plant.done and time.perf_counter() < self._next:
            return
        info = controller.info
        numbers = (
            f"{plant.time:4.1f} s  cost {info.cost:<6.4g} η {info.eta:<4.0f} β {info.beta:<7.2g} "
            f"goal {plant.error.position:.3f} m  plan {info.plan_ms:.0f} ms"
        )
        self._bar.update(self._task, completed=plant.time, numbers=numbers, refresh=True)
        self._next = time.perf_counter() + self.PERIOD


class _FirstWarning(logging.Handler):
    """Shows the first warning of an episode; the results count the rest."""

    def __init__(self, shown: bool):
        super().__init__(logging.WARNING)
        self.shown, self.said = shown, False

    def emit(self, record: logging.LogRecord) -> None:
        """Show the first record."""
        if self.shown and not self.said:
            print(f"warning: {record.getMessage()}", file=sys.stderr)
        self.said = True
