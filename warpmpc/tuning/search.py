# SPDX-License-Identifier: Apache-2.0
"""The search: trials side by side, each evaluated episode by episode, kept in a file and taken up again."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import optuna
from optuna.trial import FrozenTrial, TrialState

from ..run.code import scene_digest
from ..scene.errors import SceneError
from ..scene.load import load_scene
from ..scene.schema import Scene
from .score import Outcome
from .space import Parameter

Submit = Callable[[str, int, tuple[str, ...]], Future[Outcome]]
"""Starts an episode, given its scene's source, its seed and the tuned values as overrides."""
DONE = (TrialState.COMPLETE, TrialState.PRUNED)
START = "start"
"""Attribute of the trial of the scenes' present values."""


class LatestMedianPruner(optuna.pruners.MedianPruner):
    """Compares a trial as it stands with the others' median; Optuna's own compares its best mean so far.

    The reported values are running means over episodes: one lucky first episode would keep a trial alive for ever.
    """

    def prune(self, study: optuna.Study, trial: FrozenTrial) -> bool:
        """Return whether a trial is worse than the median of the others after as many episodes."""
        if trial.last_step is None:
            return False
        latest = copy.copy(trial)
        latest.intermediate_values = {trial.last_step: trial.intermediate_values[trial.last_step]}
        return super().prune(study, latest)


@dataclass(frozen=True, kw_only=True)
class Task:
    """Keys that are tuned, and scenes that they are tuned on."""

    scenes: dict[str, Scene]
    """Source, as for ``load_scene`` → scene with its overrides."""
    space: list[Parameter]
    start: dict[str, object]
    """The scenes' present values by key."""
    seeds: list[int]
    overrides: list[str] = field(default_factory=list)
    contact_penalty: float
    """Price of contact beyond a graze [s]."""

    @property
    def episodes(self) -> list[tuple[str, int]]:
        """Scene and seed of every episode of a trial, in order."""
        return [(source, seed) for seed in self.seeds for source in self.scenes]

    def describe(self) -> dict[str, object]:
        """Describe what must be the same when a study is taken up again."""
        return {
            "scenes": {source: scene_digest(scene) for source, scene in self.scenes.items()},
            "seeds": self.seeds,
            "keys": {parameter.key: str(parameter) for parameter in self.space},
            "overrides": self.overrides,
            "contact_penalty": self.contact_penalty,
        }

    def changes(self, values: dict[str, object]) -> tuple[str, ...]:
        """Overrides that set values by key."""
        return tuple(f"{parameter.key}={parameter.text(values[parameter.key])}" for parameter in self.space)


def open_study(path: Path | None, task: Task, *, seed: int = 0) -> optuna.Study:
    """Make a study, or take one up: what ran when it was interrupted is tried again.

    Args:
        path: SQLite file of the study; None for a study in memory.
        seed: Seed of the sampler.

    Raises:
        ValueError: If the file holds a study of something else, or none.
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    if path is not None:
        path.absolute().parent.mkdir(parents=True, exist_ok=True)
    try:
        study = optuna.create_study(
            storage=None if path is None else f"sqlite:///{path.absolute()}",
            study_name="tune",
            load_if_exists=True,
            pruner=LatestMedianPruner(n_startup_trials=4),
        )
    except Exception as error:  # whatever the database and its driver raise
        raise ValueError(f"--study {path}: cannot be opened: {str(error).splitlines()[0]}") from None
    # not the same random start again after an interruption
    study.sampler = optuna.samplers.TPESampler(multivariate=True, constant_liar=True, seed=seed + len(study.trials))
    described = json.loads(json.dumps(task.describe()))
    if (before := study.user_attrs.get("task")) is None:
        study.set_user_attr("task", described)
        study.enqueue_trial(task.start, user_attrs={START: True})
    elif before != described:
        other = ", ".join(name for name in described if described[name] != before.get(name))
        raise ValueError(f"--study {path}: was made with other {other}: take another file, or delete it")
    for trial in study.get_trials(states=(TrialState.RUNNING,)):
        study.tell(trial.number, state=TrialState.FAIL)
        study.enqueue_trial(trial.params, user_attrs={START: True} if START in trial.user_attrs else None)
    return study


def done(study: optuna.Study) -> list[FrozenTrial]:
    """Trials that have run to their end or were pruned."""
    return study.get_trials(deepcopy=False, states=DONE)


@dataclass
class _Running:
    """A trial under way."""

    trial: optuna.Trial
    values: dict[str, object]
    scores: list[float] = field(default_factory=list)
    reached: int = 0


def best(study: optuna.Study, task: Task) -> tuple[FrozenTrial, FrozenTrial | None, dict[str, object]] | None:
    """The best trial, that of the scenes' own values, and the best one's values; None before one is complete."""
    complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    if not complete:
        return None
    found = min(complete, key=lambda trial: trial.value)
    rounded = {p.key: float(f"{v:.6g}") if isinstance(v := found.params[p.key], float) else v for p in task.space}
    return found, next((trial for trial in complete if START in trial.user_attrs), None), rounded


def search(
    study: optuna.Study,
    task: Task,
    submit: Submit,
    *,
    parallel: int,
    trials: int,
    on_trial: Callable[[FrozenTrial], None],
) -> None:
    """Run trials until the study holds as many, some side by side.

    After every episode a trial whose mean is worse than the median of the others' is pruned. Values that make no
    scene count as pruned at once.

    Args:
        trials: Number of trials the study shall hold.

    Raises:
        SceneError: If the scenes' present values make no scene.
        ValueError: If the engine or device is unknown or not to be had here.
        LostJob: If an episode's process died whenever it was tried.
    """
    running: dict[Future, _Running] = {}
    left = trials - len(done(study))
    while running or left > 0:
        while left > 0 and len(running) < parallel:
            left -= 1
            trial = study.ask()
            current = _Running(trial, {parameter.key: parameter.suggest(trial) for parameter in task.space})
            try:
                for source in task.scenes:
                    load_scene(source, overrides=[*task.overrides, *task.changes(current.values)])
                running[submit(*task.episodes[0], task.changes(current.values))] = current
            except SceneError as error:
                _refuse(study, trial, error)
                on_trial(study.trials[trial.number])
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            current = running.pop(future)
            if (following := _note(study, task, current, future)) is not None:
                running[submit(*following, task.changes(current.values))] = current
            else:
                on_trial(study.trials[current.trial.number])


def _note(study: optuna.Study, task: Task, current: _Running, future: Future[Outcome]) -> tuple[str, int] | None:
    """Take an episode's result into account; returns the trial's next episode, None when it is over."""
    trial, step = current.trial, len(current.scores)
    try:
        outcome = future.result()
    except SceneError as error:
        _refuse(study, trial, error)
        return None
    current.scores.append(outcome.value)
    current.reached += outcome.passed
    average = float(np.mean(current.scores))
    trial.report(average, step)
    trial.set_user_attr("scores", current.scores)
    trial.set_user_attr("reached", current.reached)
    if step + 1 == len(task.episodes):
        study.tell(trial, average)
        return None
    if START not in trial.user_attrs and trial.should_prune():
        study.tell(trial, state=TrialState.PRUNED)
        return None
    return task.episodes[step + 1]


def _refuse(study: optuna.Study, trial: optuna.Trial, error: SceneError) -> None:
    """End a trial whose values make no scene; present values that do not are the user's mistake."""
    if START in trial.user_attrs:
        study.tell(trial, state=TrialState.FAIL)
        raise error
    trial.set_user_attr("refused", str(error))
    study.tell(trial, state=TrialState.PRUNED)
