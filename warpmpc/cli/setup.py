# SPDX-License-Identifier: Apache-2.0
"""Parts that commands share: exit codes, errors as one line, and a scene made ready for its episodes."""

from __future__ import annotations

import logging
import math
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

import typer

from ..scene.errors import SceneError
from ..scene.load import load_scene
from ..scene.schema import EngineName, SampleCount
from .terms import load_terms

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ..model.compiled import CompiledScene
    from ..run.batch import Batch
    from ..run.episode import Episode
    from ..scene.schema import Scene

logger = logging.getLogger("warpmpc")

SUCCESS, FAILURE, BAD_INPUT = 0, 1, 2
"""Exit codes, besides that of an interrupted run."""
WHILE_RUNNING = (SceneError, OSError)
"""Errors that input may still cause while episodes run: a term of a user's own, a disk that is full."""


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
    """Start Warp without its banner, its reports of loaded modules and its complaint about a missing GPU.

    Raises:
        typer.Exit: If its folder of compiled kernels cannot be made; one line on stderr says so.
    """
    import warp as wp

    from ..compiling import native_output
    from ..kernel_cache import refusal

    logging.getLogger("newton").setLevel(logging.WARNING)
    logging.getLogger("trimesh").setLevel(logging.CRITICAL)  # it logs tracebacks of ways of reading that failed
    wp.config.log_level = wp.LOG_WARNING
    try:
        with native_output() as said:  # the complaint comes from native code
            wp.init()
    except OSError as error:
        with user_errors():
            raise refusal(error) from error
    except BaseException:
        print(*said, sep="\n", file=sys.stderr)
        raise


def begin(scene: Scene, device: str, *, say: Callable[[str], None] = logger.info, quick: bool = False) -> None:
    """Tell a terminal which scene it is before what takes long begins, start Warp, begin to compile what plans need.

    Args:
        scene: The scene.
        device: Device of the rollouts.
        say: Shows a line.
        quick: Whether its own kernels are first compiled without optimization.
    """
    say = say if sys.stderr.isatty() else logger.debug
    say(f"{scene.name}: {scene.title}" if scene.title else scene.name)
    start_warp()
    from ..bake.simd import native_lanes
    from ..compiling import LONG, UNOPTIMIZED, compile_beside, prepare_headers
    from ..physics.kernel import options

    seconds = 0.0
    if not device.startswith("cuda"):
        prepare_headers(options(native_lanes()) | (UNOPTIMIZED if quick else {}))
        seconds = compile_beside()
    if seconds >= LONG:
        say(f"compiling the kernels that all scenes share, once on this machine, about {seconds:.0f} s")


@dataclass(frozen=True, kw_only=True)
class RunArguments:
    """Scene, engine and device that a command is given."""

    source: str
    """Scene and variant."""
    overrides: tuple[str, ...] = ()
    """``KEY=VALUE`` texts."""
    term_files: tuple[Path, ...] = ()
    """Python files of cost terms."""
    engine: str = "auto"
    device: str = "auto"


class Setup:
    """A scene with everything that its episodes share.

    Raises:
        SceneError: If the scene is wrong.
        ValueError: If engine or device is unknown, or a file of terms cannot be used.
    """

    def __init__(self, arguments: RunArguments):
        engine = self.engine = arguments.engine
        self.device = arguments.device
        self.scene: Scene = load_scene(arguments.source, overrides=arguments.overrides)
        if engine not in EngineName.names():
            raise ValueError(f"--engine: no engine '{engine}'; there is: {', '.join(EngineName.names())}")
        begin(self.scene, self.device)
        from ..engine.mujoco import silence_mujoco
        from ..run.episode import compile_shared

        silence_mujoco()  # files that are put together differ in sizes that mean nothing here

        self.compiled: CompiledScene | None = compile_shared(self.scene)
        terms = load_terms(arguments.term_files)
        self._shared = {"engine": engine, "device": self.device, "terms": terms, "compiled": self.compiled}

    def episode(self, seed: int, **options: bool) -> Episode:
        """The episode of a seed, ready to run."""
        from ..run.episode import Episode

        return Episode(self.scene, seed=seed, **self._shared, **options)

    def advice(self, compiled: CompiledScene | None, *, plan_ms: float = math.nan) -> list[str]:
        """Sentences on what in the scene is probably a mistake, or too slow for its controls.

        Args:
            compiled: The scene compiled; None where every episode has bodies of its own.
            plan_ms: Wall time of a plan [ms] where it matters; what ``samples = "auto"`` chose is never too slow.
        """
        from ..doctor.advice import advise, slow_plans

        chosen = self.scene.planner.samples is SampleCount.AUTO
        late = None if chosen else slow_plans(plan_ms, self.scene.timing.control_dt)
        return [*(advise(self.scene, compiled) if compiled else []), *([late] if late else [])]

    def batch(self, seeds: Sequence[int], envs: int) -> Batch:
        """The episodes of several seeds, ready to run on one controller."""
        from ..run.batch import Batch

        return Batch(self.scene, seeds, envs=envs, **self._shared)
