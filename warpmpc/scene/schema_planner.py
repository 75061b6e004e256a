# SPDX-License-Identifier: Apache-2.0
"""The types of the planner.

The type of what follows plans in real time, at its own rate, and when it does not trust them.
"""

from __future__ import annotations

import math
from enum import StrEnum, nonmember
from typing import Annotated, Self

from pydantic import Discriminator, Field, ModelWrapValidatorHandler, Tag, model_validator

from .registry import STRATEGIES, Name
from .schema_sampling import Ancillary, Covariance, Execute, Noise, Postures, Temperature, TryMean, numbers_or_table
from .types import (
    Count,
    Finite,
    Flag,
    Natural,
    NonNegative,
    NonNegatives,
    OneOrMore,
    Positive,
    Positives,
    Section,
    Share,
    TwoOrMore,
)


class Method(Name):
    """Strategies of plans."""

    MPPI = "mppi"
    PREDICTIVE_SAMPLING = "predictive_sampling"
    CEM = "cem"
    TSALLIS = "tsallis"
    DIAL = "dial"
    ICEM = "icem"
    GRADIENT_DESCENT = "gradient_descent"
    ILQG = "ilqg"
    ILQS = "ilqs"

    registry = nonmember(STRATEGIES)


class SplineKind(StrEnum):
    """Spline through the knots."""

    ZERO = "zero"
    LINEAR = "linear"
    CUBIC = "cubic"
    BSPLINE = "bspline"


class Risk(StrEnum):
    """Risk measure that combines the costs of a sample in several domains."""

    MEAN = "mean"
    WORST = "worst"
    BEST = "best"
    CVAR = "cvar"
    VAR = "var"
    EXPONENTIAL = "exponential"


class SampleCount(StrEnum):
    """A number of samples that is not given."""

    AUTO = "auto"
    """As many as fit into a control on this machine, measured."""


class StepCount(StrEnum):
    """A number of steps that is not given."""

    AUTO = "auto"
    """As many as look ``planner.lookahead`` ahead."""


class KnotCount(StrEnum):
    """A number of knots that is not given."""

    STEPS = "steps"
    """One for each step."""


AHEAD, STEP = 1.2, 0.08
"""How far ``horizon = "auto"`` looks ahead, and the length of its steps, rounded to whole controls [s]."""


def _number_or_flag(value: object) -> str:
    return "flag" if isinstance(value, bool) else "number"


def _number_or_text(value: object) -> str:
    return "text" if isinstance(value, str) else "number"


Kept = Annotated[Annotated[Flag, Tag("flag")] | Annotated[Natural, Tag("number")], Discriminator(_number_or_flag)]

Samples = Annotated[
    Annotated[TwoOrMore, Tag("number")] | Annotated[SampleCount, Tag("text")], Discriminator(_number_or_text)
]


Knots = Annotated[
    Annotated[TwoOrMore, Tag("number")] | Annotated[KnotCount, Tag("text")], Discriminator(_number_or_text)
]
Horizon = Annotated[Annotated[Count, Tag("number")] | Annotated[StepCount, Tag("text")], Discriminator(_number_or_text)]


class Growing(Section):
    """Steps that grow: fine near the present, long far ahead (STORM)."""

    first: Positive
    """Length of the first steps [s]."""
    last: Positive
    """Length of the last step [s]; the steps in between grow linearly."""
    constant: Count = 1
    """How many steps have the length ``first``."""


Steps = Annotated[
    Annotated[Positives, Tag("numbers")] | Annotated[Growing, Tag("table")], Discriminator(numbers_or_table)
]


class Refinement(StrEnum):
    """Methods by which derivatives improve a plan."""

    AUTO = "auto"
    GRADIENT = "gradient"
    ILQG = "ilqg"


class Refine(Section):
    """Refinement of the plan by derivatives: finite differences of physics and cost residuals along its rollout."""

    method: Refinement = Refinement.AUTO
    """``gradient``: steepest descent on the knots. ``ilqg``: box-DDP, with a feedback gain for every control. ``auto``
    is ``ilqg`` on a CPU if the engine has physics, every term can be evaluated step by step, none watches contacts, and
    finite differences need at most half as many worlds as the samples."""
    iterations: Count = 1
    """Expansions, each followed by a line search."""
    candidates: TwoOrMore = 8
    """Step sizes of a line search, tried in parallel: zero, and from one down to a thousandth."""


DIRECT = frozenset({Method.ILQG, Method.ILQS})
"""Methods whose plans are the controls themselves, whatever ``planner.knots`` says: iLQG solves for them. They are held
where the scene's spline is a smooth one."""

_ALGORITHM_4 = {
    "iterations": 1,
    "noise": {"source": "random", "shape": "identity", "spread": (1.0, 1.0), "constant": 0.0, "null_sample": False},
}
PRESETS = {
    Method.PREDICTIVE_SAMPLING: _ALGORITHM_4,
    Method.GRADIENT_DESCENT: {"refine": {"method": "gradient"}},
    Method.ILQG: {"refine": {"method": "ilqg"}},
    Method.ILQS: {**_ALGORITHM_4, "refine": {"method": "ilqg"}},
    Method.DIAL: {"iterations": 4, "noise": {"shape": "identity", "anneal": (0.5, 2.0)}},
    Method.ICEM: {
        "iterations": 3,
        "elites": 10,
        "keep_best": 3,
        "decay": 1.25,
        "step_size": 0.9,
        "try_mean": "last",
        "execute": "best",
        "covariance": {"form": "knots", "restart": True},
        "noise": {"shape": "coloured", "exponent": 2.0, "null_sample": False},
    },
}
"""What methods mean where the scene does not say otherwise: ``dial`` is MPPI whose σ is annealed (2409.15610), ``icem``
the cross-entropy method with what Pinneri et al. (CoRL 2020) add to it. The others are MuJoCo MPC's planners
(2212.00541), its Alg. 4 first: fresh white Gaussian knots at every plan, the nominal among the candidates."""


DERIVATIVES = {"iterations": 1, "knots": KnotCount.STEPS, "spline": "zero", "noise": {"shape": "bspline"}}
"""Defaults of plans whose derivatives are taken along every step of the samples, which is a single control."""


class Planner(Section):
    """The sampling-based planner.

    The defaults suit most tasks: smooth plans 1.2 s ahead, fine and coarse samples, a temperature that adapts to the
    cost, and two rounds of samples (with one, a quadrotor hovered in 2 of 6 runs, with two in 6). After ``mppi``, iLQG
    improves the plan in steps of one control (``refine``). With ``refine.method = "gradient"``, ``ilqg`` and ``ilqs``
    samples have steps of one control, too, and the defaults ``iterations = 1``, ``knots = "steps"``,
    ``spline = "zero"`` and ``noise.shape = "bspline"``.
    """

    method: Method = Method.MPPI
    """Strategy, also a registered one."""
    samples: Samples = 256
    """Candidate control sequences S, or ``auto``: as many as fit into a control on this machine, measured by
    ``warpmpc run`` and ``warpmpc.fit_samples``."""
    horizon: Horizon = StepCount.AUTO
    """Steps T of a rollout, or ``auto``: from ``lookahead``, or as many as ``dt`` lists."""
    lookahead: Positive | None = None
    """How far plans look ahead [s], in place of ``horizon``; 1.2 without either. It depends on the task, not on the
    machine: long enough for the cost to improve."""
    dt: Steps | None = None
    """Length of the steps of a rollout [s]: one number, one for each step, or a table (see ``Growing``). When left out,
    about 0.08 s in whole controls; one control with methods that use derivatives. Longer steps are cheaper."""
    domains: Count = 1
    """Draws D of physical properties in which each sample is rolled out; S·D rollouts. With 1, every sample has its own
    draw."""
    randomize: Flag = True
    """Whether the rollouts' worlds have the randomized properties of ``[randomize]``; when false all are nominal."""
    risk: Risk = Risk.MEAN
    """Risk measure that combines the costs of a sample in several domains."""
    cvar: Share = 0.25
    """Share of the worst domains: ``risk = "cvar"`` is their mean cost, ``risk = "var"`` their least."""
    aversion: Finite = 1.0
    """R of ``risk = "exponential"``, log(mean e^{R S})/R, per unit of cost; zero is the mean."""
    stage_risk: Finite = 0.0
    """R of ρ(l; R) = (e^{R l} - 1)/R, which every step's cost l, summed over the terms, goes through; zero is l itself
    [M5]. Positive ones shun single bad steps, negative ones bound what a step can cost by -1/R."""
    knots: Knots = 5
    """Spline control points P, by default at most one per step, and 10 where noise by default would turn a robot over;
    or ``steps``, one per step, as always for ``ilqg`` and ``ilqs``."""
    spline: SplineKind = SplineKind.CUBIC
    """Spline through the knots."""
    discount: Share = 1.0
    """Factor γ per step of a rollout [P5]."""
    terminal: NonNegative = 1.0
    """Factor on the cost of the last step, in addition to the discount."""
    noise: Noise = Noise()
    """Noise that is added to the mean."""
    temperature: Temperature = Temperature()
    """How strongly cheap samples are preferred."""
    step_size: Share = 1.0
    """Step α of the mean towards the weighted samples [S4]."""
    covariance: Covariance = Covariance()
    """Adaptation of the covariance of the samples."""
    keep_best: Kept = 0
    """Number of the best samples so far that are tried again, shifted by the time passed; ``true`` is one."""
    try_mean: TryMean = TryMean.ALWAYS
    """In which iterations the mean itself is one of the samples."""
    sequences: str | None = None
    """File of control sequences that are samples of every plan: ``.npy`` or ``.npz`` with ``[n, T or P, nu]``, or
    ``.csv`` with one sequence per line, step by step."""
    postures: Postures | None = None
    """Joint motions to postures that bring a frame to a pose, as samples of every plan."""
    ancillary: Annotated[tuple[Ancillary, ...], OneOrMore] = ()
    """Proposals of samples for the observed state: your own functions, stored motions, policies."""
    refine: Refine | None = Refine()
    """Refinement of the plan by derivatives, by default for ``mppi`` alone. ``gradient_descent`` and ``ilqg`` refine
    without samples, ``ilqs`` is ``predictive_sampling`` refined by ``ilqg``."""
    execute: Execute = Execute.MEAN
    """Controls that are sent: the mean, the best of the last samples, or a sample of the updated distribution."""
    iterations: Count = 2
    """Rounds of samples per plan."""
    decay: Annotated[Positive, Field(ge=1.0)] = 1.0
    """γ of a shrinking population: iteration i has S/γ^i samples, at least twice the ``elites``."""
    elites: Count = 8
    """``cem``, ``icem`` and ``tsallis``: best samples that carry weight."""
    entropic_index: Annotated[Positive, Field(gt=1.0)] = 2.0
    """``tsallis``: r > 1 of w ∝ (1 - ΔS/γ)^{1/(r-1)}; large ones weigh the elites equally."""
    sigma_min: NonNegatives = (0.01,)
    """Floor of an adapted standard deviation, in control units, one value or one per control."""

    @model_validator(mode="wrap")
    @classmethod
    def _preset(cls, data: object, handler: ModelWrapValidatorHandler[Self]) -> Self:
        """Fill in what a method means by itself; what the scene says comes first, and it alone counts as set."""
        if not isinstance(data, dict):
            return handler(data)
        method = data.get("method")
        preset = PRESETS.get(method, {}) if isinstance(method, str) else {}
        refine = data.get("refine", preset.get("refine"))
        wanted = {**preset.get("refine", {}), **refine}.get("method") if isinstance(refine, dict) else None
        direct = isinstance(method, str) and method in DIRECT
        base = DERIVATIVES if refine and (direct or wanted == Refinement.GRADIENT) else {}
        if method not in (None, Method.MPPI):
            base = {"refine": None, **base}
        out = {**base, **preset, **data}
        for key in ("noise", "temperature", "covariance", "refine"):
            tables = [part[key] for part in (base, preset, data) if part.get(key) is not None]
            if all(isinstance(table, dict) for table in tables) and tables:
                out[key] = {name: value for table in tables for name, value in table.items()}
        if direct:
            smooth = out.get("spline") in (SplineKind.CUBIC, SplineKind.BSPLINE)
            out |= {"knots": KnotCount.STEPS} | ({"spline": SplineKind.ZERO} if smooth else {})
        planner = handler(out)
        planner.__pydantic_fields_set__.intersection_update(data)
        for key in ("noise", "temperature", "covariance", "refine"):
            said = data.get(key)
            if isinstance(said, dict):
                getattr(planner, key).__pydantic_fields_set__.intersection_update(said)
        return planner

    @model_validator(mode="after")
    def _steps(self) -> Planner:
        if self.refine is None and self.method in (Method.ILQG, Method.GRADIENT_DESCENT):
            raise ValueError(f'method = "{self.method}" has no samples, only refine: leave refine = false out')
        if self.horizon is StepCount.AUTO:
            if isinstance(self.dt, Growing):
                raise ValueError('horizon = "auto" does not go with steps that grow: give horizon a number')
            if self.lookahead is not None and self.dt and len(self.dt) > 1:
                raise ValueError("dt lists every step: leave lookahead out, or give dt one number")
        elif self.lookahead is not None and (
            not isinstance(self.dt, tuple) or self.horizon != self._steps_ahead(self.dt[0])
        ):
            raise ValueError("horizon and lookahead say the same: leave one out")
        elif isinstance(self.dt, tuple) and len(self.dt) not in (1, self.horizon):
            raise ValueError(f"dt has one number, or {self.horizon}: one for each step of the horizon")
        return self

    def _steps_ahead(self, dt: float) -> int:
        return max(1, math.ceil((self.lookahead or AHEAD) / dt - 1e-9))

    def with_horizon(self, control_dt: float) -> Planner:
        """Return the planner with the number of steps, and their length, that ``auto`` stands for.

        Args:
            control_dt: Length of a control [s].
        """
        open_ended = self.horizon is StepCount.AUTO
        single = self.refine and not self.finishes
        if single and not open_ended:
            return self
        whole = 1 if single else max(1, round(STEP / control_dt))
        dt = self.dt or (whole * control_dt,)
        steps = self.horizon
        if open_ended:
            steps = len(dt) if len(dt) > 1 else self._steps_ahead(dt[0])
        update = {"horizon": steps, "dt": dt}
        if "knots" not in self.model_fields_set and isinstance(self.knots, int):
            update["knots"] = min(self.knots, steps) if steps > 1 else KnotCount.STEPS
        planner = self.model_copy(update=update)
        said = self.model_fields_set - ({"horizon"} if open_ended else set())  # worked out is not said
        planner.__pydantic_fields_set__.intersection_update(said)
        return planner

    @property
    def finishes(self) -> bool:
        """True where iLQG may go on from samples, which keep their own steps and knots."""
        return self.refine is not None and self.refine.method is not Refinement.GRADIENT and self.method not in DIRECT

    @property
    def knot_count(self) -> int | None:
        """Number of knots P; None for one per step."""
        return self.knots if isinstance(self.knots, int) else None

    @model_validator(mode="after")
    def _domains_differ(self) -> Planner:
        if self.domains > 1 and not self.randomize:
            raise ValueError("domains > 1 tries samples in different worlds: set randomize = true or domains = 1")
        return self


class SafeCommand(StrEnum):
    """Safe command of drives by effort, where nothing can be trusted; other drives stop, or hold where they are."""

    REST = "rest"
    GRAVITY = "gravity"


class Plans(StrEnum):
    """Plans for every control."""

    ONE = "one"
    FIT = "fit"


class AgentSettings(Section):
    """The agent follows the newest plan in real time, or sends the safe command."""

    rate: Positive = 500.0
    """Rate of observations and commands [Hz]."""
    plan_timeout: Positive = 0.09
    """Largest age of the observation that a plan was made from [s]. The next plan comes after two latencies, so it must
    be more than that."""
    observation_timeout: Positive = 0.05
    """Largest age of an observation, and longest time in which a moving robot may send equal joint positions [s]."""
    plans: Plans = Plans.ONE
    """Plans per control if plant and planner run in parallel: ``one``, or as many as ``fit``: then a slower clock gives
    more plans [Alg. 1 of 2212.00541]."""
    slew: Positives | None = None
    """Largest change of the controls per second, one value or one per control [control unit/s], also of the safe
    command; no limit when left out."""
    safe: SafeCommand = SafeCommand.REST
    """Safe command of effort drives: the efforts that held the start, else zero (``rest``), or gravity compensation at
    the last observation (``gravity``)."""
    compensate: Flag = True
    """Whether observations are predicted forward by the latency of plans."""
