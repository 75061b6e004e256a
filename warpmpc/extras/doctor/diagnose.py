# SPDX-License-Identifier: Apache-2.0
"""Diagnosis of a run: the one thing that, changed in the planner's predictions, makes them agree with what came."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ...scene.errors import SceneError
from .foresight import Physics, Rolled, Windows, logged_steps, takes_mujoco_steps

if TYPE_CHECKING:
    from ...cost.term import UserTerm
    from ...loop.log.run_log import RunLog
    from ...scene.model.compiled import CompiledScene
    from ...scene.schema import Scene

GOOD = 0.1
"""Error of predicted states, as a share of their movement, up to which nothing is looked for."""
HELPS = 0.6
"""Share of the error that a cause leaves when it is taken away."""


@dataclass(frozen=True)
class Trial:
    """A change that was tried."""

    cause: str
    """The change that was tried."""
    before: float
    """Error of predicted states without the change, a share of how far they moved."""
    after: float
    """The same with it."""
    cure: str
    """Cure where this is the cause, with its key."""

    @property
    def helps(self) -> bool:
        """Return whether the change takes most of the error away."""
        return self.before > GOOD and self.after <= HELPS * self.before


@dataclass(frozen=True)
class Diagnosis:
    """Changes tried on one run."""

    error: float
    """Error of what the planner predicted."""
    cost: float
    """Its error in costs."""
    trials: tuple[Trial, ...]
    """One change each; the last makes all of them."""

    @property
    def cause(self) -> Trial | None:
        """The change that helps most, None where none does."""
        return min((t for t in self.trials[:-1] if t.helps), key=lambda trial: trial.after, default=None)

    @property
    def sentence(self) -> str:
        """The cause and its cure in one sentence, or that there is none."""
        if max((trial.before for trial in self.trials), default=self.error) <= GOOD:
            return f"nothing found: the planner foresees what comes, {self.error:.1%} of the movement off"
        if (cause := self.cause) is not None:
            more = [t.cause for t in self.trials[:-1] if t.helps and t is not cause]
            besides = f" (so do: {', '.join(more)})" if more else ""
            helped = f"{cause.cause}: this takes the error from {cause.before:.0%} to {cause.after:.0%}{besides}"
            return f"{helped}; {cause.cure}"
        return (
            "nothing tried explains the error: kicks, pulls, things that move by themselves, or controls that were "
            "changed on the way"
        )


def diagnose(
    log: RunLog, scene: Scene, compiled: CompiledScene, *, terms: Sequence[UserTerm] = ()
) -> tuple[Diagnosis, list[str]]:
    """Roll a run's controls out as its planner predicted them, with one thing changed at a time.

    Args:
        log: The run.
        scene: Its scene.
        compiled: The scene, compiled.
        terms: Users' own cost terms that the scene names.

    Returns:
        The diagnosis, and what could not be tried.

    Raises:
        SceneError: If the scene cannot be built here.
        ValueError: If the log is of another kind, or too short.
    """
    windows = Windows(scene, compiled, logged_steps(log, scene), terms)
    if not len(windows.rows):
        raise ValueError("it is too short: there is no state to compare predictions with")
    engine, device = log.origin["engine"], log.origin["device"]
    planner = Physics.of_planner(scene, compiled, engine if takes_mujoco_steps(engine, scene) else "mujoco")
    plant = Physics.of_plant(scene, compiled, log.origin["seed"])

    def error(rolled: Rolled) -> float:
        return float(windows.error(rolled).mean())

    base = windows.roll_out(planner)
    before, came = error(base), windows.roll_out(plant, noise=False, delay=False)
    found, trials, left_out = base, [], []
    if engine != "mujoco":
        try:
            found = windows.roll_out(planner, engine=engine, device=device)
            trials.append(Trial(f"MuJoCo's physics in place of the engine {engine}", error(found), before, ENGINE))
        except (SceneError, ValueError) as reason:
            left_out.append(f"the engine {engine}: {reason}")
    changes = _changes(scene, planner, plant)
    trials += [Trial(name, before, error(roll(windows)), cure) for name, cure, roll in changes]
    trials.append(Trial("all of these", trials[0].before, error(came), ""))
    known = np.isfinite(found.cost) & np.isfinite(came.cost)
    paid = np.abs(came.cost[known]).sum()
    cost = np.abs(found.cost - came.cost)[known].sum() / paid if paid else 0.0
    return Diagnosis(error(found), float(cost), tuple(trials)), left_out


ENGINE = "take --engine mujoco (engine.name), and report it: engines should agree"
Change = tuple[str, str, Callable[[Windows], Rolled]]


def _changes(scene: Scene, planner: Physics, plant: Physics) -> list[Change]:
    """Changes of a prediction: name, cure, and how pieces are rolled out with it."""
    step, fine = (scene.timing.control_dt * p.hold / p.substeps for p in (planner, plant))
    found = []
    if not np.isclose(step, fine):
        found.append(
            (
                f"physics steps of {1e3 * fine:.3g} ms, as the plant's, in place of {1e3 * step:.3g} ms",
                f"raise engine.substeps {max(2, round(step / fine))}-fold, or take a shorter planner.dt",
                lambda w: w.roll_out(replace(planner, substeps=plant.substeps, hold=1)),
            )
        )
    if plant.settings != planner.settings:
        found.append(
            (
                "the plant's solver",
                "raise engine.iterations and lower engine.tolerance",
                lambda w: w.roll_out(replace(planner, settings=plant.settings)),
            )
        )
    if plant.properties is not None and plant.properties.names:
        found.append(
            (
                "the plant's masses, friction and sizes",
                "correct the planner's model (mass, friction, size; in simulation plant.factor, plant.randomize), or "
                "plan for several models: [randomize] with planner.domains",
                lambda w: w.roll_out(replace(planner, properties=plant.properties)),
            )
        )
    return [
        *found,
        (
            "observations without delay",
            "give the state as it is now: predict it by the controls sent since, or read sensors faster (in simulation "
            "plant.delay)",
            lambda w: w.roll_out(planner, delay=False),
        ),
        (
            "observations without noise",
            "filter what is observed, velocities above all (in simulation plant.noise)",
            lambda w: w.roll_out(planner, noise=False),
        ),
    ]
