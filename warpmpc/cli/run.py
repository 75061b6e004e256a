# SPDX-License-Identifier: Apache-2.0
"""``warpmpc check`` and ``warpmpc run``: build, run, report, and fail with one message."""

from __future__ import annotations

import logging
import sys
import time
from contextlib import closing
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

from ..scene.load import load_scene, variants
from ..scene.registry import OBSERVERS
from .interrupts import Interrupts
from .progress import BatchBar, EpisodeBar, Messages
from .setup import FAILURE, SUCCESS, WHILE_RUNNING, RunArguments, Setup, others_whole, results_only, user_errors
from .terminal import say, say_json

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ..loop.run.episode import Episode
    from ..loop.run.result import EpisodeResult
    from ..loop.run.workers import KeptResults
    from .outputs import Outputs
    from .run_folder import RunFolder

logger = logging.getLogger("warpmpc")

WARM_UP = 2
"""Plans of a check that do not count: the first compiles kernels."""
LONGEST = 2.0
"""Time after which no more of those that count are made [s]."""


def check(arguments: RunArguments, *, seed: int, measure: bool = False) -> int:
    """Build what a run of the scene would, make one plan and show what was built; returns the exit code.

    The scene's variants are read, too; one of them is built by its name.
    """
    with results_only() as out, Messages(notices=True, warnings=True), Interrupts() as interrupts:
        try:
            with user_errors():
                setup = Setup(arguments)
                if setup.scene.variant is None:
                    for variant in variants(arguments.source):
                        load_scene(f"{arguments.source}:{variant}", overrides=arguments.overrides)
                episode = setup.episode(seed, measure=measure)
                plan_ms = _plan_ms(episode)

            from ..extras.doctor.examine import examine
            from .describe import print_check

            controller = episode.controller
            advice = setup.advice(controller.compiled, plan_ms=plan_ms)
            findings = examine(controller, episode.plant.monitor)
            print_check(episode, out, plan_ms=plan_ms, advice=[*advice, *map(str, findings)])
        except KeyboardInterrupt:
            return interrupts.code
    return SUCCESS


def _plan_ms(episode: Episode) -> float:
    """Run the first seconds of an episode, and make a plan from its start; returns the median time of its plans [ms].

    Plans from the start alone would tell too little: they take longer where a robot touches something.
    """
    controller, plant = episode.controller, episode.plant
    observation, times = plant.observe(), []
    for _ in range(WARM_UP):
        controller.step(observation)
    until = time.perf_counter() + LONGEST
    while not plant.done and time.perf_counter() < until:
        control = controller.step(observation)
        times.append(controller.info.plan_ms)
        plant.apply(control)
        observation = plant.observe()
    plant.reset()
    controller.reset()
    controller.step(plant.observe())
    return median(times or [controller.info.plan_ms])


def run(
    arguments: RunArguments,
    *,
    seeds: Sequence[int],
    envs: int,
    outputs: Outputs,
    jobs: str | None,
    results_file: Path | None,
    json_lines: bool,
    quiet: bool,
    advise: bool = False,
) -> int:
    """Run one episode per seed, up to ``envs`` at once, report, and return the exit code."""
    results: list[EpisodeResult] = []
    kept: KeptResults | None = None
    folder: RunFolder | None = None
    interrupted = False
    notices = not quiet and not json_lines
    with results_only() as out, Messages(notices=notices, warnings=not quiet) as messages, Interrupts() as interrupts:
        try:
            with user_errors():
                _check_options(outputs, seeds, envs, jobs, results_file)
                if advise and not OBSERVERS:
                    raise ValueError("--advise: needs a verdict, which warpmpc's extras bring")
                if advise and results_file is not None:
                    raise ValueError("--advise: not with --results, which keeps what came of runs, not of trials")
                envs = min(envs, len(seeds))
                setup = Setup(arguments)
                kept = _kept(results_file, setup, arguments.term_files)
                asked = {"engine": arguments.engine, "device": arguments.device, "jobs": jobs}
                folder = outputs.folder(setup.scene, seeds=seeds, term_files=arguments.term_files, asked=asked)
            if jobs is not None:
                from .spread import run_spread

                files = {"outputs": outputs, "kept": kept}
                episodes = run_spread(arguments, setup, seeds, envs, jobs=jobs, shown=not quiet, **files)
            elif envs > 1:
                episodes = _run_batch(setup, seeds, envs, interrupts, shown=not quiet)
            else:
                episodes = _run_each(setup, seeds, outputs, kept, messages, interrupts, shown=not quiet)
            with closing(episodes):
                for result in episodes:
                    interrupted |= result.reason == "interrupted"
                    if advise and result.shortfall is not None and not interrupted:
                        from .advise import advised

                        result, interrupted = advised(arguments, setup, result)
                        advise = False  # further episodes mostly fail in the same way
                    results.append(result)
                    if folder is not None:
                        with others_whole():
                            folder.add(result.to_json())
                    if json_lines:
                        say_json(result.to_json(), out)
        except KeyboardInterrupt:
            interrupted = True
        finally:
            if folder is not None:
                folder.end()
        if kept is not None and kept.outdated:
            logger.warning("%s: %d of its results were made by another state of warpmpc", results_file, kept.outdated)
        if kept is not None and kept.taken and outputs.any:
            what = "%s has %d of these episodes: they were not run again, so no files of theirs were written"
            logger.warning(what, results_file, kept.taken)
        exported = None
        with others_whole():
            exported = outputs.export.close() if outputs.export is not None else None
        if results and not json_lines and not quiet:
            from .describe import ALIKE, properties_drawn
            from .report import print_batch, print_results

            results.sort(key=lambda result: result.seed)
            (print_batch if envs > 1 else print_results)(results, out)
            if len(results) > 1 and not (results[0].drawn or properties_drawn(setup.scene)):
                say(f"seeds {ALIKE}", out=out)
            for sentence in setup.advice(setup.compiled):
                say(f"Advice: {sentence}", out=out)
            if exported is not None:
                say(exported, out=out)
    if interrupted:
        if len(seeds) > 1 and not quiet:
            again = f"the same command{' with a new --out' * (folder is not None)} continues"
            goes_on = again if results_file else "a command with --results FILE can be continued"
            done = sum(result.reason != "interrupted" for result in results)
            say(f"interrupted: {done} of {len(seeds)} episodes are done; {goes_on}", out=sys.stderr)
        return interrupts.code
    return SUCCESS if all(result.passed for result in results) and not messages.unwritten else FAILURE


def _check_options(
    outputs: Outputs, seeds: Sequence[int], envs: int, jobs: str | None, results_file: Path | None
) -> None:
    """Refuse options that do not go together.

    Raises:
        ValueError: If some do not.
        OSError: If a file cannot be written.
    """
    outputs.check(seeds, envs=envs, jobs=jobs)
    if jobs is not None:
        from ..loop.run.workers import check_jobs

        check_jobs(jobs)
    elif results_file is not None and envs > 1:
        raise ValueError("--results: with --envs, what is planned together is a job: add --jobs, such as --jobs 1")


def _kept(file: Path | None, setup: Setup, term_files: Sequence[Path]) -> KeptResults | None:
    """Results kept in a file.

    Raises:
        OSError: If the file cannot be read or written.
        ValueError: If it holds something else.
    """
    if file is None:
        return None
    from ..physics.runtime.files import try_file

    file.parent.mkdir(parents=True, exist_ok=True)
    try_file(file)
    from ..loop.run.workers import KeptResults

    return KeptResults(file, setup.scene, term_files=term_files, engine=setup.engine, device=setup.device)


def _run_each(
    setup: Setup,
    seeds: Sequence[int],
    outputs: Outputs,
    kept: KeptResults | None,
    messages: Messages,
    interrupts: Interrupts,
    *,
    shown: bool,
) -> Iterator[EpisodeResult]:
    """Run one episode after the other, to the last or to Ctrl-C; those that are kept already are not run."""
    with EpisodeBar(setup.scene.timing.timeout, seeds, shown=shown) as bar:
        for seed in seeds:
            if kept is not None and (found := kept.find([seed])):
                yield from found
                continue
            messages.warned = False
            result = _run_one(setup, seed, outputs, bar, interrupts)
            if kept is not None and result.reason != "interrupted":
                with others_whole():
                    kept.add([seed], result)
            yield result
            if result.reason == "interrupted":
                return


def _run_one(setup: Setup, seed: int, outputs: Outputs, bar: EpisodeBar, interrupts: Interrupts) -> EpisodeResult:
    """Run the episode of one seed, to its end or to Ctrl-C."""
    from ..loop.run.episode import EpisodeInterrupted

    with user_errors():
        episode = setup.episode(seed)
        interrupts.check()
        recorders = outputs.recorders(episode)
    bar.start(seed)

    def on_step(*step) -> None:
        bar.step(*step)
        interrupts.check()

    try:
        with user_errors(WHILE_RUNNING):
            result = episode.run(recorder=recorders, on_step=on_step)
    except EpisodeInterrupted as error:
        result = error.result
    if (log := recorders.run_log) is not None:
        outputs.save(log, seed, result)
    return result


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
