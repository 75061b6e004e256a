# SPDX-License-Identifier: Apache-2.0
"""Parts that commands share: exit codes, errors as one line, and a scene made ready for its episodes.

Arguments and options that several commands share.
"""

from __future__ import annotations

import importlib
import logging
import math
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TextIO

import typer

from ..cost.user_files import load_terms
from ..physics.runtime.files import Output, Unwritable, reason
from ..scene.errors import MOST, SceneError
from ..scene.load import load_scene
from ..scene.schema import EngineName, SampleCount
from .terminal import say

if TYPE_CHECKING:
    from types import ModuleType

    from ..cost.term import UserTerm
    from ..loop.run.batch import Batch
    from ..loop.run.episode import Episode
    from ..scene.model.compiled import CompiledScene
    from ..scene.schema import Scene

logger = logging.getLogger("warpmpc")

SUCCESS, FAILURE, BAD_INPUT = 0, 1, 2
"""Exit codes, besides that of an interrupted run."""
WHILE_RUNNING = (SceneError, OSError)
"""Errors that input may still cause while episodes run: a term of a user's own, a disk that is full."""


@contextmanager
def user_errors(kinds: tuple[type[Exception], ...] = (ValueError, OSError)) -> Iterator[None]:
    """Turn wrong input into exit code 2, a file that cannot be written into exit code 1, each with a line on stderr.

    A scene has a line for each of its mistakes.

    Args:
        kinds: Exceptions that mean wrong input; a ``SceneError`` is a ``ValueError``.
    """
    try:
        yield
    except (Unwritable, *kinds) as error:
        each = [part.line for part in error.each] if isinstance(error, SceneError) else [str(error)]
        if isinstance(error, OSError) and error.errno and error.filename is not None:
            each = [f"{error.filename}: {reason(error)}"]
        for text in each[:MOST]:
            say(f"error: {' '.join(text.split())}", out=sys.stderr)
        if len(each) > MOST:
            say(f"error: and {len(each) - MOST} more", out=sys.stderr)
        raise typer.Exit(FAILURE if isinstance(error, Unwritable) else BAD_INPUT) from None


@contextmanager
def others_whole() -> Iterator[None]:
    """Show that a file cannot be written, and go on with the others."""
    try:
        yield
    except Unwritable as error:
        logger.error("%s", error)


@contextmanager
def results_only() -> Iterator[TextIO]:
    """The real standard output, as a file; meanwhile whatever else is printed there goes to stderr."""
    sys.stdout.flush()
    real = os.dup(1)
    os.dup2(2, 1)
    out = Output(os.fdopen(os.dup(real), "wb"), encoding="utf-8")
    try:
        with user_errors((Unwritable,)):
            try:
                yield out
            finally:
                sys.stdout.flush()
                out.flush()
    finally:
        os.dup2(real, 1)
        os.close(real)
        with suppress(OSError):
            out.close()


def start_warp() -> None:
    """Start Warp without its banner, its reports of loaded modules and its complaint about a missing GPU.

    Raises:
        typer.Exit: If its folder of compiled kernels cannot be made; one line on stderr says so.
    """
    import warp as wp

    from ..physics.runtime.compiling import native_output
    from ..physics.runtime.kernel_cache import refusal

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
        say(*said, out=sys.stderr)
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
    from ..physics.runtime.bake import native_lanes
    from ..physics.runtime.compiling import LONG, UNOPTIMIZED, compile_beside, prepare_headers
    from ..physics.source_parts import options

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
    """Python files of cost terms, strategies, engines and robots."""
    engine: str = "auto"
    device: str = "auto"

    def load(self) -> tuple[Scene, list[UserTerm]]:
        """The scene and the terms of the files, which are executed first: a scene may name what they register."""
        if self.term_files:
            start_warp()
        terms = load_terms(self.term_files)
        return load_scene(self.source, overrides=self.overrides), terms


def extra(name: str) -> ModuleType | None:
    """A module of the extras; None where they are not installed."""
    try:
        return importlib.import_module(f"warpmpc.extras.{name}")
    except ModuleNotFoundError as error:
        if f"warpmpc.extras.{name}.".startswith(f"{error.name}."):
            return None
        raise


class Setup:
    """A scene with everything that its episodes share.

    Raises:
        SceneError: If the scene is wrong.
        ValueError: If engine or device is unknown, or a file of terms cannot be used.
    """

    def __init__(self, arguments: RunArguments):
        engine = self.engine = arguments.engine
        self.device = arguments.device
        self.scene, terms = arguments.load()
        if engine not in EngineName.names():
            raise ValueError(f"--engine: no engine '{engine}'; there is: {', '.join(EngineName.names())}")
        begin(self.scene, self.device)
        from ..engine.mujoco import silence_mujoco
        from ..loop.run.episode import compile_shared

        silence_mujoco()  # files that are put together differ in sizes that mean nothing here

        self.compiled: CompiledScene | None = compile_shared(self.scene)
        self._shared = {"engine": engine, "device": self.device, "terms": terms, "compiled": self.compiled}

    def episode(self, seed: int, **options: bool) -> Episode:
        """The episode of a seed, ready to run."""
        from ..loop.run.episode import Episode

        return Episode(self.scene, seed=seed, **self._shared, **options)

    def advice(self, compiled: CompiledScene | None, *, plan_ms: float = math.nan) -> list[str]:
        """Sentences on what in the scene is probably a mistake, or too slow for its controls.

        Args:
            compiled: The scene compiled; None where every episode has its own bodies.
            plan_ms: Wall time of a plan [ms] where it matters; what ``samples = "auto"`` chose is never too slow.
        """
        from ..loop.realtime.pace import slow_plans

        doctor = extra("doctor.advice")
        chosen = self.scene.planner.samples is SampleCount.AUTO
        late = None if chosen else slow_plans(plan_ms, self.scene.timing.control_dt)
        return [*(doctor.advise(self.scene, compiled) if compiled and doctor else []), *([late] if late else [])]

    def batch(self, seeds: Sequence[int], envs: int) -> Batch:
        """The episodes of several seeds, ready to run on one controller."""
        from ..loop.run.batch import Batch

        return Batch(self.scene, seeds, envs=envs, **self._shared)


SceneArgument = Annotated[
    str,
    typer.Argument(
        metavar="SCENE",
        help="Shipped scene (see warpmpc scenes) or TOML file; SCENE:A or SCENE:A+B for variants of it.",
    ),
]
SetOption = Annotated[
    list[str],
    typer.Option("--set", metavar="KEY=VALUE", help="Change the scene, such as planner.samples=500; repeatable."),
]
LAST_SEED = 2**28
"""Largest seed; the kernels' seeds derived from it stay 32-bit integers."""
SeedOption = Annotated[int, typer.Option(min=0, max=LAST_SEED, help="Seed of the episode.")]
TermsOption = Annotated[
    list[Path],
    typer.Option(
        "--terms",
        metavar="FILE.py",
        help="Python file with cost terms, strategies, engines or robots of yours; it is executed.",
    ),
]
EngineOption = Annotated[
    str,
    typer.Option(
        "--engine",
        metavar="ENGINE",
        help="Engine of the rollouts: fused, mujoco (on the CPU), mujoco_warp and newton (on a GPU), kinematic (no "
        "physics), or auto: the scene's choice, else fused where it can do what the scene asks for.",
    ),
]
DeviceOption = Annotated[
    str,
    typer.Option(
        "--device",
        metavar="DEVICE",
        help="Device of the rollouts: cpu, a GPU such as cuda:0, or auto: the faster, measured once.",
    ),
]


def run_arguments(scene: str, overrides: list[str], terms: list[Path], engine: str, device: str) -> RunArguments:
    """What several commands are given, as one."""
    return RunArguments(source=scene, overrides=tuple(overrides), term_files=tuple(terms), engine=engine, device=device)
