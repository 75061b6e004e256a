# SPDX-License-Identifier: Apache-2.0
"""``warpmpc tune``: search values of scene keys over seeds, print them as a change of the scene's file."""

from __future__ import annotations

import difflib
import importlib.util
import sys
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from ..loop.run.ray_workers import DIED
from ..loop.run.workers import check_jobs, one_thread, open_workers
from ..physics.runtime.files import Unwritable, try_file
from ..scene.load import load_scene
from .interrupts import Interrupts
from .progress import Bar, Messages
from .setup import FAILURE, SUCCESS, RunArguments, Setup, results_only, start_warp, user_errors
from .spread import portable, shared_setup
from .terminal import say

if TYPE_CHECKING:
    from collections.abc import Sequence

    from optuna import Study
    from optuna.trial import FrozenTrial

    from ..extras.tuning.search import Outcome, Submit, Task
    from ..scene.schema import Scene

LAST_SEED = 999
"""Tuning has seeds 0 to 999: results are reported on seeds above them."""


def tune(
    given: Sequence[RunArguments],
    *,
    keys: Sequence[str],
    trials: int,
    seeds: range,
    jobs: str,
    study_file: Path | None,
    out: Path | None,
    contact_penalty: float,
) -> int:
    """Run or go on with a study of scenes that are tuned together, print what it found, and return the exit code."""
    with (
        results_only() as printed,
        Messages(notices=True, warnings=False),
        Interrupts() as interrupts,
        ExitStack() as end,
    ):
        try:
            with user_errors():
                if importlib.util.find_spec("optuna") is None:
                    raise ValueError('tuning needs optuna: pip install "warpmpc[tune]"')
                check_jobs(jobs)
                if seeds[-1] > LAST_SEED:
                    raise ValueError(f"--seed, --episodes: tuning has seeds 0 to {LAST_SEED}, not {seeds[-1]}")
                setups = {arguments.source: Setup(arguments) for arguments in given}
                scenes = {source: setup.scene for source, setup in setups.items()}
                overrides = list(given[0].overrides)
                base = _file_to_change(scenes, out)
                if out is not None:
                    try_file(out)
                from ..extras.tuning.search import Task, open_study
                from ..extras.tuning.space import bind_space, derive_space, parse_space

                space = parse_space(keys or list(dict.fromkeys(t for s in scenes.values() for t in derive_space(s))))
                space, start = bind_space(space, scenes, overrides)
                task = Task(
                    scenes=scenes,
                    space=space,
                    start=start,
                    seeds=list(seeds),
                    overrides=overrides,
                    contact_penalty=contact_penalty,
                )
                study = open_study(study_file, task)
            for parameter in space:
                say(f"--key {parameter.key}={parameter}", out=sys.stderr)
            with user_errors():
                submit, parallel = _submitter(given, setups, task, jobs, end)
                code = _search(study, task, submit, parallel, trials, study_file)
        except BrokenProcessPool:
            say(f"error: {DIED}", out=sys.stderr)
            return FAILURE
        except KeyboardInterrupt:
            with user_errors():
                _report(study, task, base, out, printed)
            return interrupts.code
        with user_errors():
            _report(study, task, base, out, printed)
    return code


def run_trial(arguments: RunArguments, changes: tuple[str, ...], seed: int, contact_penalty: float) -> Outcome:
    """Run one episode of a trial.

    Raises:
        SceneError: If the values make no scene.
        ValueError: If the engine or device is not available here.
    """
    from ..extras.tuning.search import Score

    episode = shared_setup(replace(arguments, overrides=(*arguments.overrides, *changes))).episode(seed)
    own = load_scene(arguments.source, overrides=arguments.overrides)
    score = Score(own, episode.plant, contact_penalty=contact_penalty)
    try:
        return score.outcome(episode.run(on_step=score))
    finally:
        episode.controller.engine.close()


def _submitter(
    given: Sequence[RunArguments], setups: dict[str, Setup], task: Task, jobs: str, end: ExitStack
) -> tuple[Submit, int]:
    """Function that starts an episode, and the number that run side by side."""
    workers, device = None, given[0].device
    if jobs != "1":
        workers, device = open_workers(jobs, device=device, prepare=start_warp)
        end.enter_context(workers)
    orders = {
        arguments.source: replace(
            arguments,
            source=portable(arguments.source, setups[arguments.source]),
            overrides=arguments.overrides if workers is None else one_thread(workers, arguments.overrides),
            term_files=tuple(path.absolute() for path in arguments.term_files),
            device=device,
        )
        for arguments in given
    }

    def submit(source: str, seed: int, changes: tuple[str, ...]) -> Future[Outcome]:
        call = (orders[source], changes, seed, task.contact_penalty)
        if workers is not None:
            return workers.submit(run_trial, *call)
        done: Future[Outcome] = Future()
        try:
            done.set_result(run_trial(*call))
        except Exception as error:
            done.set_exception(error)
        return done

    return submit, 1 if workers is None else workers.count


def _search(study: Study, task: Task, submit: Submit, parallel: int, trials: int, file: Path | None) -> int:
    """Search with a bar and a line for every trial; returns the exit code of a study whose file could be written."""
    from ..extras.tuning.search import best, done, search, writing_study

    with Bar(trials, shown=True) as bar:

        def on_trial(trial: FrozenTrial) -> None:
            line, found = f"trial {trial.number}: {_described(trial, task)}", best(study, task)
            if bar.console:
                bar.console.print(line, soft_wrap=True)
            else:
                say(line, out=sys.stderr)
            count = len(done(study))
            bar.draw(f"{count}/{trials} trials", count, f"best {_worth(found[0], task)}" if found else "")

        bar.draw(f"{len(done(study))}/{trials} trials", len(done(study)), "")
        try:
            with writing_study(file):
                search(study, task, submit, parallel=parallel, trials=trials, on_trial=on_trial)
        except Unwritable as error:  # what was found until then is told
            say(f"error: {error}", out=sys.stderr)
            return FAILURE
    return SUCCESS


def _described(trial: FrozenTrial, task: Task) -> str:
    """A trial's value in a line."""
    if refused := trial.user_attrs.get("refused"):
        return f"refused: {refused}"
    count, total = len(trial.user_attrs["scores"]), len(task.episodes)
    cut = f", pruned after {count} of {total} episodes" if count < total else ""
    return f"{_worth(trial, task)}, {_passed(trial)} passed{cut}"


def _worth(trial: FrozenTrial, task: Task) -> str:
    """Mean worth of a trial's episodes with its unit; of costs, what failures add is left out."""
    from ..extras.tuning.search import FAILED_COST

    scores = [score - FAILED_COST * (score >= FAILED_COST) for score in trial.user_attrs["scores"]]
    unit = "s" if all(scene.success for scene in task.scenes.values()) else "cost"
    return f"{sum(scores) / len(scores):.4g} {unit}"


def _passed(trial: FrozenTrial) -> str:
    return f"{trial.user_attrs['reached']} of {len(trial.user_attrs['scores'])}"


def _file_to_change(scenes: dict[str, Scene], out: Path | None) -> tuple[Path, str | None] | None:
    """The file and the variant that the values go into; None where the scenes stand in several files.

    Raises:
        ValueError: If such a file shall be written.
    """
    paths = {scene.path for scene in scenes.values()}
    if len(paths) > 1 and out is not None:
        raise ValueError(f"--output {out}: the scenes stand in several files: tune those of one, or leave it out")
    first = next(iter(scenes.values()))
    return None if len(paths) > 1 else (first.path, first.variant if len(scenes) == 1 else None)


def _report(study: Study, task: Task, base: tuple[Path, str | None] | None, out: Path | None, printed: TextIO) -> None:
    """Print the best trial beside the scenes' own values, and its values as a change of the file; write it if asked to.

    Raises:
        SceneError: If the file would not be the scene that was tuned.
        OSError: If it cannot be written.
    """
    from ..extras.live.saving import edited, save
    from ..extras.tuning.search import best

    if (found := best(study, task)) is None:
        say("no trial was completed", out=printed)
        return
    trial, first, values = found
    if first:
        say(f"start  trial {first.number}: {_described(first, task)}", out=printed)
    say(f"best   trial {trial.number}: {_described(trial, task)}", out=printed)
    say(
        f"tuned on {', '.join(task.scenes)}, seeds {task.seeds[0]} to {task.seeds[-1]}: report other seeds",
        out=printed,
    )
    if first is None:
        say("the scene's own values were not tried to the end: nothing is known to be better", out=printed)
        return
    if trial is first:
        say("no trial was better than the scene's own values and passed as often", out=printed)
        return
    if not trial.user_attrs["reached"]:
        say("warning: no episode passed with these values either", out=sys.stderr)
    changes = task.changes(values)
    if base is None:
        say("", *(f"--set {change}" for change in changes), out=printed)
        return
    path, variant = base
    before, after = path.read_text(encoding="utf-8-sig"), edited(path, variant, changes)
    lines = difflib.unified_diff(before.splitlines(), after.splitlines(), path.name, "tuned", n=1, lineterm="")
    say("", *lines, out=printed)
    if out is not None:
        save(path, variant, changes, to=out)
        say(f"wrote {out}: {_passed(trial)} passed, {_passed(first)} before", out=printed)
