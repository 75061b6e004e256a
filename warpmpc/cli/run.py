# SPDX-License-Identifier: Apache-2.0
"""What ``warpmpc check`` and ``warpmpc run`` do: build, run, report, and fail with one message."""

from __future__ import annotations

import json
import logging
import os
import signal
import sys
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

import typer

from ..scene.errors import SceneError
from ..scene.load import load_scene
from ..scene.schema import EngineName
from .progress import BatchBar, EpisodeBar, Messages
from .terms import load_terms

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from types import FrameType

    from ..cost.term import ArrayCost, CostTerm
    from ..model.compiled import CompiledScene
    from ..run.batch import Batch
    from ..run.episode import Episode, EpisodeResult
    from ..scene.schema import Scene

SUCCESS, FAILURE, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
"""Exit codes."""
WHILE_RUNNING = (SceneError, OSError)
"""What can still be wrong with the input of episodes that run: a term of a user's own, a disk that is full."""


@contextmanager
def user_errors(kinds: tuple[type[Exception], ...] = (ValueError, OSError)) -> Iterator[None]:
    """Turn wrong input into one line on stderr and exit code 2.

    Args:
        kinds: Exceptions that mean wrong input; a ``SceneError`` is a ``ValueError``.
    """
    try:
        yield
    except kinds as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
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

    from ..compiling import native_output

    logging.getLogger("newton").setLevel(logging.WARNING)
    logging.getLogger("trimesh").setLevel(logging.CRITICAL)  # it logs tracebacks of ways of reading that failed
    wp.config.log_level = wp.LOG_WARNING
    try:
        with native_output() as said:  # the complaint comes from native code
            wp.init()
    except BaseException:
        print(*said, sep="\n", file=sys.stderr)
        raise


class Interrupts:
    """Ctrl-C that cannot get lost.

    Native code that calls back into Python may swallow a ``KeyboardInterrupt``: pydantic's serializer turns one into a
    warning. So it is also written down, and raised again by :meth:`check`; below pydantic it is only written down.
    """

    def __init__(self):
        self._pressed = False

    def __enter__(self) -> Interrupts:
        self._before = signal.getsignal(signal.SIGINT)
        if self._before is signal.default_int_handler:
            signal.signal(signal.SIGINT, self._note)
        return self

    def __exit__(self, *error: object) -> None:
        if self._before is signal.default_int_handler:
            signal.signal(signal.SIGINT, self._before)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._pressed = True
        while frame is not None:
            if frame.f_globals.get("__name__", "").startswith("pydantic."):
                return
            frame = frame.f_back
        raise KeyboardInterrupt

    def check(self) -> None:
        """Raise ``KeyboardInterrupt`` if Ctrl-C was pressed."""
        if self._pressed:
            raise KeyboardInterrupt


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
        from ..run.episode import compile_shared

        self.compiled: CompiledScene | None = compile_shared(self.scene)
        self.terms: list[CostTerm | ArrayCost] = load_terms(term_files)

    def episode(self, seed: int) -> Episode:
        """The episode of a seed, ready to run."""
        from ..run.episode import Episode

        return Episode(
            self.scene,
            seed=seed,
            engine=self.engine,
            device=self.device,
            terms=self.terms,
            compiled=self.compiled,
        )

    def batch(self, seeds: Sequence[int], envs: int) -> Batch:
        """The episodes of several seeds, ready to run on one controller."""
        from ..run.batch import Batch

        return Batch(
            self.scene,
            seeds,
            envs=envs,
            engine=self.engine,
            device=self.device,
            terms=self.terms,
            compiled=self.compiled,
        )


def check(
    source: str, *, overrides: Sequence[str], term_files: Sequence[Path], seed: int, engine: str, device: str
) -> int:
    """Build what a run of the scene would, make one plan and show what was built; returns the exit code."""
    with results_only() as out, Messages(notices=True, warnings=True):
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
    envs: int,
    overrides: Sequence[str],
    term_files: Sequence[Path],
    engine: str,
    device: str,
    record: Path | None,
    json_lines: bool,
    quiet: bool,
) -> int:
    """Run one episode per seed, up to ``envs`` at once, report, and return the exit code."""
    results: list[EpisodeResult] = []
    interrupted = False
    notices = not quiet and not json_lines
    with results_only() as out, Messages(notices=notices, warnings=not quiet) as messages, Interrupts() as interrupts:
        try:
            with user_errors():
                _check_record(record, envs)
                envs = min(envs, len(seeds))
                setup = Setup(source, overrides=overrides, term_files=term_files, engine=engine, device=device)
            if envs > 1:
                episodes = _run_batch(setup, seeds, envs, interrupts, shown=not quiet)
            else:
                episodes = _run_each(setup, seeds, record, messages, interrupts, shown=not quiet)
            with closing(episodes):
                for result in episodes:
                    interrupted |= result.reason == "interrupted"
                    results.append(result)
                    if json_lines:
                        print(json.dumps(result.to_json(), ensure_ascii=False, allow_nan=False), file=out, flush=True)
        except KeyboardInterrupt:
            interrupted = True
        if results and not json_lines and not quiet:
            from .report import print_batch, print_results

            (print_batch if envs > 1 else print_results)(results, out)
    if interrupted:
        return INTERRUPTED
    return SUCCESS if all(result.success for result in results) else FAILURE


def _check_record(record: Path | None, envs: int) -> None:
    """Refuse recordings that cannot be made.

    Raises:
        ValueError: If this is one.
    """
    if record is None:
        return
    if envs > 1:
        raise ValueError("--record: a recording shows one environment: leave out --envs or --record")
    if not record.absolute().parent.is_dir():
        raise ValueError(f"--record: no such folder: {record.absolute().parent}")


def _run_each(
    setup: Setup,
    seeds: Sequence[int],
    record: Path | None,
    messages: Messages,
    interrupts: Interrupts,
    *,
    shown: bool,
) -> Iterator[EpisodeResult]:
    """Run one episode after the other, to the last or to Ctrl-C."""
    with EpisodeBar(setup.scene.timing.timeout, seeds, shown=shown) as bar:
        for seed in seeds:
            messages.warned = False
            # of several recordings, each has its seed in its name
            path = record.with_stem(f"{record.stem}-{seed}") if record is not None and len(seeds) > 1 else record
            result = _run_one(setup, seed, path, bar, interrupts)
            yield result
            if result.reason == "interrupted":
                return


def _run_one(setup: Setup, seed: int, path: Path | None, bar: EpisodeBar, interrupts: Interrupts) -> EpisodeResult:
    """Run the episode of one seed, to its end or to Ctrl-C."""
    from ..run.episode import EpisodeInterrupted

    with user_errors():
        episode = setup.episode(seed)
        interrupts.check()
        recorder = None
        if path is not None:
            from ..record.recorder import Recorder  # slow to import

            recorder = Recorder(path, episode.controller, episode.plant)
    bar.start(seed)

    def on_step(*step) -> None:
        bar.step(*step)
        interrupts.check()

    try:
        with user_errors(WHILE_RUNNING):
            return episode.run(recorder=recorder, on_step=on_step)
    except EpisodeInterrupted as error:
        return error.result


def _run_batch(
    setup: Setup, seeds: Sequence[int], envs: int, interrupts: Interrupts, *, shown: bool
) -> Iterator[EpisodeResult]:
    """Run up to ``envs`` episodes at once, to the last or to Ctrl-C."""
    with BatchBar(len(seeds), shown=shown) as bar:
        with user_errors():
            batch = setup.batch(seeds, envs)
        interrupts.check()

        def on_step(*step) -> None:
            bar.step(*step)
            interrupts.check()

        with user_errors(WHILE_RUNNING):
            for result in batch.run(on_step=on_step):
                bar.finish(result)
                yield result
