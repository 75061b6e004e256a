# SPDX-License-Identifier: Apache-2.0
"""Results of episodes, as plain values and as JSON.

Guesses why an episode failed: what its run shows, what may help, and the changes of the scene that try it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from ...scene.describe import written
from ...scene.schema import ShareOfRange

if TYPE_CHECKING:
    from ...planner.controller.controller import Controller


@dataclass(frozen=True, kw_only=True)
class Result:
    """End of one episode, of any kind."""

    scene: str
    variant: str | None
    seed: int
    success: bool | None
    """True if the goal was reached; None where the scene does not say when it is."""
    reason: str
    """Its end: ``goal reached``, ``failed: NAME``, ``timeout``, ``the plant's physics diverged``, ``interrupted``."""
    sim_time: float
    """Simulated time [s]."""
    mean_cost: float | None = None
    """Mean over all controls of what the cost terms come to in the plant, with their weights; None where the scene has
    a ``success``."""

    @property
    def passed(self) -> bool:
        """Return whether the episode ended as it should.

        With success or, where the scene does not define it, in time.
        """
        return self.reason == "timeout" if self.success is None else self.success


@dataclass(frozen=True, kw_only=True)
class EpisodeResult(Result):
    """Result of one episode, as plain values; lengths in metres, angles in radians, times in seconds."""

    engine: str
    device: str
    steps: int
    """Controls applied."""
    position_error: float | None
    """Final distance to the goal [m], None without a goal."""
    yaw_error: float | None
    """Final heading error [rad], None for a goal without orientation."""
    cost: float
    """Cost of the last plan's best sample; NaN without a plan."""
    max_force: float | None
    """Largest net force between robots or objects and obstacles [N]; None where the plant watches no such pair."""
    time_in_contact: float | None
    """Time of contact between robots or objects and obstacles [s]; None where the plant watches no such pair."""
    plan_ms: dict[str, float]
    """Wall time of a plan of all environments [ms]: ``p50``, ``p90``, ``p99``, ``max``; NaN without a plan."""
    stages_ms: dict[str, float]
    """Median wall time of each stage of a plan [ms]; NaN on a CUDA device, where one graph runs them all."""
    diverged_worlds: int
    """Rollouts whose physics blew up, summed over the episode."""
    samples: int
    horizon: int
    fallbacks: int
    """Safe commands sent because no rollout survived."""
    envs: int = 1
    """Environments that every plan planned for at once."""
    axis_error: float | None = None
    """Final error along the axis that is farthest from its tolerance [m], None without tolerances along axes."""
    phases: tuple[tuple[str, float], ...] = ()
    """Phases of the task that were entered after the first, and when [s]."""
    reached: int | None = None
    """Phases that ended because what they wait for had come, the last one with the success; None without phases."""
    drawn: dict[str, object] = field(default_factory=dict)
    """Values drawn for this episode by scene key; empty when the scene draws nothing."""

    proposers: dict[str, float] = field(default_factory=dict)
    """Share of the plans that each of :data:`~warpmpc.scene.model.state.PROPOSERS` won, and that derivatives lowered
    (``lowered``); empty without derivatives."""

    foresight: dict[str, float] = field(default_factory=dict)
    """Error of predictions for the controls sent, as a share of how far the state moved (``state``: after
    one control, ``state_ahead``: after 0.2 s) and of the cost paid (``cost``); empty where it is not known, and in
    batches of several environments."""

    verdict: tuple[str, ...] = ()
    """Likely reasons why an episode did not succeed, each with what to try."""

    shortfall: Shortfall | None = field(default=None, repr=False, compare=False)
    """The same as data, where there was a verdict; not part of the JSON."""

    tried: tuple[dict[str, Any], ...] = ()
    """With ``--advise``: changes of the scene that were tried (``set``), whether they helped (``helped``, None where
    none can tell), how far the episode came with them (``outcome``), and when it reached the goal (``reached_s``)."""

    @property
    def time_to_goal(self) -> float | None:
        """Simulated time at which the goal was reached [s], None when it was not."""
        return self.sim_time if self.success else None

    def to_json(self) -> dict[str, Any]:
        """The result as data for JSON: plain types, units in the keys, ``None`` for numbers that are not finite."""
        data: dict[str, Any] = {}
        for name in dict.fromkeys(
            (*FIRST, *(known.name for known in fields(self) if known.name not in (*LAST, "shortfall")), *LAST)
        ):
            value = getattr(self, name)
            left_out = self.success is not None if name == "mean_cost" else value in (None, (), {})
            if name in LEFT_OUT and left_out:
                continue
            if name == "phases":
                value = [{"phase": phase, "time_s": time} for phase, time in value]
            *outer, key = JSON_KEYS.get(name, (name,))
            (data.setdefault(*outer, {}) if outer else data)[key] = value
        return plain(data)

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> EpisodeResult:
        """The result that :meth:`to_json` wrote; a number that was not finite is NaN."""
        found: dict[str, Any] = {}
        for known in fields(cls):
            if known.name == "shortfall":
                continue
            *outer, key = JSON_KEYS.get(known.name, (known.name,))
            inner = data[outer[0]] if outer else data
            if known.name in LEFT_OUT and key not in inner:
                continue
            value = inner[key]
            if known.name == "phases":
                value = [(entry["phase"], entry["time_s"]) for entry in value]
            if isinstance(value, list):
                value = tuple(value)
            if value is None and (known.type == "float" or known.name == "mean_cost"):
                value = math.nan
            if known.type == "dict[str, float]":
                value = {name: math.nan if number is None else number for name, number in value.items()}
            found[known.name] = value
        return cls(**found)


FIRST = ("scene", "variant", "seed", "engine", "device", "success", "reason", "time_to_goal", "sim_time", "steps")
LAST = ("mean_cost", "foresight", "verdict", "tried")
"""Parts of a result that are first and last as JSON; others have the order of the fields."""
JSON_KEYS = {
    "time_to_goal": ("time_to_goal_s",),
    "sim_time": ("sim_time_s",),
    "position_error": ("final", "position_error_m"),
    "yaw_error": ("final", "yaw_error_rad"),
    "axis_error": ("final", "axis_error_m"),
    "cost": ("final", "cost"),
    "max_force": ("collisions", "max_force_N"),
    "time_in_contact": ("collisions", "time_in_contact_s"),
}
"""Place of those parts of a result that have another one as JSON."""
LEFT_OUT = ("mean_cost", "axis_error", "phases", "reached", "drawn", "proposers", "foresight", "verdict", "tried")
"""Fields that are left out of JSON where there is nothing to say."""


def plain(value: Any) -> Any:
    """Data as JSON can say it."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value


ENDS = 20.0
"""Factor on the last step that is advised: with it the end counts more than fifteen steps of the way."""
MANY = 128
"""Samples that are advised at least."""


@dataclass(frozen=True)
class Guess:
    """A likely reason why an episode failed."""

    seen: str
    """What the run shows, with its figures; empty for what is merely worth a try."""
    cure: str = ""
    """What to try, in words."""
    changes: Mapping[str, str] = field(default_factory=dict)
    """The same as values by key, as ``--set`` takes them; empty where it takes more than a value."""

    def __str__(self) -> str:
        sets = f" ({self.sets})" if self.changes else ""
        return f"{self.seen}: {self.cure}{sets}" if self.cure else self.seen

    @property
    def sets(self) -> str:
        """The changes as options of the command line."""
        return " ".join(f"--set {change}" for change in self.overrides)

    @property
    def overrides(self) -> list[str]:
        """The changes as ``KEY=VALUE``."""
        return [f"{key}={value}" for key, value in self.changes.items()]


@dataclass(frozen=True)
class Shortfall:
    """How far an episode came that did not succeed, and guesses why."""

    guesses: tuple[Guess, ...]
    """The most telling first."""
    nearest: Mapping[str, tuple[float, float]]
    """Numbers that are not as wanted by name: the best value, and how far it is beyond its bound."""
    phases: int
    """Phases that ended because what they wait for had come."""
    lasted: float | None
    """When it fell, failed or diverged [s]; None otherwise."""

    @property
    def told(self) -> list[Guess]:
        """Guesses that something was seen of."""
        return [guess for guess in self.guesses if guess.seen]

    @property
    def tries(self) -> list[Guess]:
        """Guesses that can be tried, each change once."""
        found: dict[str, Guess] = {}
        for guess in self.guesses:
            if guess.changes:
                found.setdefault(guess.sets, guess)
        return list(found.values())


class Changes:
    """Changes of a scene's planner that guesses try.

    Args:
        controller: The controller of the episode.
    """

    def __init__(self, controller: Controller):
        self._planner, self._shape = controller.scene.planner, controller.shape
        fewer = controller.lowered is not None and self._planner.knot_count  # where σ is given and knots are not
        self._knots = {"planner.knots": str(self._planner.knots)} if fewer else {}
        self.ahead = float(controller.plan_step.grid.t[-1])
        """How far plans look ahead [s]."""
        self.numbers = controller.layout.nu * controller.plan_step.strategy.knots.shape[2]
        """Numbers of a plan: controls × knots."""

    def further(self) -> dict[str, str]:
        """Twice as far ahead, where steps have one length."""
        dt = self._planner.dt
        one = dt is None or (isinstance(dt, tuple) and len(dt) == 1)
        return {"planner.lookahead": f"{2.0 * self.ahead:.3g}"} if one else {}

    def ends(self) -> dict[str, str]:
        """The end of a plan counts more."""
        return {} if self._planner.terminal >= ENDS else {"planner.terminal": f"{ENDS:g}"}

    def rounds(self) -> dict[str, str]:
        """Twice as many rounds."""
        return {"planner.iterations": str(2 * self._planner.iterations)}

    def samples(self, factor: int = 4) -> dict[str, str]:
        """So many times as many samples, and as many as a plan has numbers."""
        return {"planner.samples": str(max(factor * self._shape.samples, MANY, self.numbers))}

    def sigma(self, factor: float | np.ndarray) -> dict[str, str]:
        """Noise that is larger or smaller by a factor, one for all controls or one for each, with the same knots."""
        sigma = self._planner.noise.sigma
        share = isinstance(sigma, ShareOfRange)
        values = [float(f"{value:.3g}") for value in np.multiply(factor, sigma.range if share else sigma)]
        text = written(values if len({*values}) > 1 else values[0]).replace(" ", "")  # a word of a shell
        return {**self._knots, f"planner.noise.sigma{'.range' * share}": text}
