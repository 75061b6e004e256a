# SPDX-License-Identifier: Apache-2.0
"""The search: trials side by side, each evaluated episode by episode, kept in a file and taken up again.

The value of an episode to a tuning; less is better.
"""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import optuna
import sqlalchemy
from optuna.trial import FrozenTrial, TrialState

from ...loop.run.workers import scene_digest
from ...physics.runtime.files import Unwritable
from ...scene.errors import SceneError
from ...scene.load import load_scene
from ...scene.schema import Scene
from .space import Parameter

if TYPE_CHECKING:
    from ...loop.plant.plant import Plant
    from ...loop.run.result import EpisodeResult
    from ...planner.controller.controller import Controller

GRAZE_FORCE = 5.0
"""Net force up to which a touched obstacle counts as grazed [N]."""
GRAZE_TIME = 0.1
"""Time in contact up to which it does [s]."""
FARTHEST = 2.0
"""Final errors beyond this many start errors count as this many."""
FAILED = 8.0
"""Least worth of an episode that failed, in timeouts; one that lasted to its timeout is worth at most seven."""
FAILED_COST = 1e9
"""What a failure adds to the mean cost of an episode without a ``success``."""


@dataclass(frozen=True)
class Outcome:
    """An episode of a trial."""

    value: float
    """Its value: seconds where the scene has a ``success``, else cost."""
    passed: bool
    """True when it ended as it should."""


class Score:
    """Values an episode; its ``on_step`` sums what the terms cost at the scene's own weights.

    Args:
        scene: The scene before tuned values, whose tolerances and weights judge all trials alike.
        plant: The episode's plant, before its first step.
        contact_penalty: Price of contact beyond a graze [s].
    """

    def __init__(self, scene: Scene, plant: Plant, *, contact_penalty: float):
        self.scene, self.plant, self.contact_penalty = scene, plant, contact_penalty
        self._weights = {cost.label: cost.weight for cost in scene.cost}
        self._start = plant.error
        self._paid, self._worst = 0.0, -math.inf

    def __call__(self, controller: Controller, plant: Plant, control: np.ndarray) -> None:
        """Add up the cost of the step just made."""
        if self.scene.success is None:
            cost = sum(self._weights[label] * value for label, value in plant.terms.items())
            self._paid, self._worst = self._paid + cost, max(self._worst, cost)

    def outcome(self, result: EpisodeResult) -> Outcome:
        """The episode's outcome.

        With a ``success``, an episode that reaches it is worth its time to the goal. One that lasts to its timeout is
        worth twice the timeout, plus the timeout times the share of the start error that is left, in position and,
        where success asks for it, in orientation (of π); one that fails or diverges more than any of these, the less
        the later. Contact beyond a graze adds a penalty of a timeout at most. Without a ``success`` the value is the
        mean cost at the scene's own weights; a failure adds ``FAILED_COST``, and the steps that it cut off cost as
        much as the worst.
        """
        value = self._seconds(result) if self.scene.success else self._mean_cost(failed=not result.passed)
        return Outcome(value, result.passed)

    def _mean_cost(self, *, failed: bool) -> float:
        steps = max(round(self.scene.timing.timeout / self.scene.timing.control_dt), self.plant.steps, 1)
        cut = steps - self.plant.steps
        mean = (self._paid + (cut * self._worst if cut else 0.0)) / steps
        return mean + FAILED_COST * failed if math.isfinite(mean) else 1e30

    def _seconds(self, result: EpisodeResult) -> float:
        timeout = self.scene.timing.timeout
        hard = (result.max_force or 0.0) > GRAZE_FORCE and (result.time_in_contact or 0.0) > GRAZE_TIME
        price = min(self.contact_penalty, timeout) * hard
        if result.success:
            return result.time_to_goal + price
        base = 2.0 if result.reason == "timeout" else FAILED + max(1.0 - result.sim_time / timeout, 0.0)
        return timeout * (base + self._left()) + price

    def _left(self) -> float:
        """Share of the start error that is left, up to four where orientation counts."""
        success, end = self.scene.success, self.plant.error
        if end is None:
            return 1.0
        tolerance = success.distance or max(success.position or (0.0,))
        left = _share(end.position, max(self._start.position, tolerance, 1e-3))
        if success.yaw is not None:
            left += _share(end.yaw, math.pi)
        elif success.rotation is not None:
            left += _share(end.rotation, math.pi)
        return left


def _share(error: float, whole: float) -> float:
    """Share of a whole that is left; an error without a value is the worst."""
    return min(error / whole, FARTHEST) if math.isfinite(error) else FARTHEST


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
        Unwritable: If it cannot be written, on a full disk for example.
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
        if "disk" in (why := _reason(error)):
            raise Unwritable(f"cannot write '{path}': {why}") from None
        raise ValueError(f"--study {path}: cannot be opened: {why}") from None
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


def _reason(error: BaseException) -> str:
    """What the driver of a database says, in a line."""
    while error.__cause__ is not None:
        error = error.__cause__
    return str(error).splitlines()[0]


@contextmanager
def writing_study(path: Path | None) -> Iterator[None]:
    """Errors of a study's file name that file.

    Raises:
        Unwritable: If it cannot be written.
    """
    try:
        yield
    except (optuna.exceptions.StorageInternalError, sqlalchemy.exc.SQLAlchemyError) as error:
        raise Unwritable(f"cannot write '{path}': {_reason(error)}") from None


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
    """The best trial of those that pass no less than the scenes' own values, that of these, and the best one's values.

    None before one is complete. The trial of the scenes' own values is None while it is not complete.
    """
    complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    if not complete:
        return None
    first = next((trial for trial in complete if START in trial.user_attrs), None)
    least = first.user_attrs["reached"] if first else 0
    found = min((trial for trial in complete if trial.user_attrs["reached"] >= least), key=lambda trial: trial.value)
    rounded = {p.key: float(f"{v:.6g}") if isinstance(v := found.params[p.key], float) else v for p in task.space}
    return found, first, rounded


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
        ValueError: If the engine or device is unknown or not available here.
        BrokenProcessPool: If a process of the jobs died.
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
