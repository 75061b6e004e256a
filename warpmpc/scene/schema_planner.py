# SPDX-License-Identifier: Apache-2.0
"""The types of what plans: the sampling-based planner, its noise and temperature, the physics of its rollouts."""

from __future__ import annotations

import math
from enum import StrEnum
from typing import Annotated, Self

from pydantic import Discriminator, Field, ModelWrapValidatorHandler, Tag, model_validator

from ..registry import ENGINES, STRATEGIES, Name, Registry
from .schema_ancillary import Ancillary
from .schema_sampling import Covariance, Execute, Postures, TryMean
from .types import (
    Channel,
    Count,
    Finite,
    Flag,
    Fraction,
    Natural,
    NonNegative,
    NonNegatives,
    OneOrMore,
    Param,
    Positive,
    Positives,
    Section,
    Share,
    TwoOrMore,
    Vec3,
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

    @classmethod
    def registry(cls) -> Registry:
        """Registry of users' strategies."""
        return STRATEGIES


class NoiseSource(StrEnum):
    """Sources of standard normals."""

    HALTON = "halton"
    SOBOL = "sobol"
    RANDOM = "random"


class NoiseShape(StrEnum):
    """Correlations of standard normals along the horizon."""

    IDENTITY = "identity"
    BSPLINE = "bspline"
    COMB = "comb"
    COLOURED = "coloured"


class Renewal(StrEnum):
    """Ways in which a low-discrepancy table is drawn anew."""

    ROTATE = "rotate"
    START = "start"


class ShareOfRange(Section):
    """A standard deviation by the range of each control, from its lower to its upper limit."""

    range: Positives
    """Share of the range, one value or one per control: 0.25 is half of the way from the middle to a limit."""


def _numbers_or_table(value: object) -> str:
    return "table" if isinstance(value, dict | Section) else "numbers"


Sigma = Annotated[
    Annotated[Positives, Tag("numbers")] | Annotated[ShareOfRange, Tag("table")], Discriminator(_numbers_or_table)
]


class Noise(Section):
    """Perturbation of the knots, ε = σ ⊙ (B z)."""

    source: NoiseSource = NoiseSource.HALTON
    """Where standard normals z come from."""
    shape: NoiseShape = NoiseShape.BSPLINE
    """How they are correlated along the horizon, B."""
    sigma: Sigma = ShareOfRange(range=(0.25,))
    """Standard deviation in control units, one value or one per control; or ``{ range = 0.25 }``, by each control's
    range, as when left out."""
    spread: tuple[Positive, Positive] = (1.0, 1.0)
    """Factors (low, high) on sigma: samples run from one to the other, so that one batch searches near and far."""
    constant: Channel = 0.0
    """Share of the samples whose noise is the same at every knot: gentle, steady motions, which independent knots of
    several controls hardly ever draw."""
    redraw: Flag | None = None
    """Fresh noise in every round; when false it is drawn once, as in the papers. When left out it is drawn anew with
    ``iterations`` above one or an adapted covariance: a σ that narrows onto the same draws carries the plan away."""
    renewal: Renewal = Renewal.ROTATE
    """How a Halton or Sobol table is drawn anew: ``rotate`` every column by a random shift modulo one, or ``start``
    every column somewhere else, which takes a tenth of the time."""
    comb: Vec3 = (0.3, 0.0, 0.7)
    """Coefficients of the comb filter (STORM)."""
    exponent: NonNegative = 1.0
    """Exponent α of coloured noise, power ∝ 1/f^α."""
    knots: Count | None = None
    """Noise knots of the shape ``bspline``, fewer of them smoother; half of the knots of a plan when left out."""
    null_sample: Flag = True
    """Whether one sample asks for nothing: no speed or effort, or the observed position held."""
    null_share: Fraction = 0.0
    """Share of the samples that ask for nothing, where that is more than the one: an arm that is nearly there coasts
    and stops (STORM)."""
    anneal: tuple[Positive, Positive] | None = None
    """β1 and β2 of DIAL-MPC: σ shrinks by exp(-i/(β1 n)) over the iterations i < n and by exp(-(1 - h)/β2) towards the
    present, h from 1/P at the first of P knots to 1 at the last."""


class Temperature(Section):
    """The inverse-exponential temperature β of MPPI."""

    initial: Positive = 1.0
    """β of the first plan, in units of cost."""
    eta: tuple[Positive, Positive] | None = (5.0, 10.0)
    """Bounds of the effective number of samples η; β follows them between plans [P6]."""
    ess: Positive | None = None
    """Effective sample size (Σw)²/Σw² that β is solved for within each plan, instead of ``eta``."""

    @model_validator(mode="before")
    @classmethod
    def _ess_replaces_default_eta(cls, data: object) -> object:
        return {"eta": None, **data} if isinstance(data, dict) and data.get("ess") else data

    @model_validator(mode="after")
    def _ordered(self) -> Temperature:
        if self.eta is not None and self.ess is not None:
            raise ValueError("only one of eta and ess can steer the temperature: switch one off, as in eta = false")
        if self.eta is not None and self.eta[0] >= self.eta[1]:
            raise ValueError(f"eta = [low, high] needs low < high; found {list(self.eta)}")
        return self


class SplineKind(StrEnum):
    """Splines by which knots become controls."""

    ZERO = "zero"
    LINEAR = "linear"
    CUBIC = "cubic"
    BSPLINE = "bspline"


class Risk(StrEnum):
    """Risk measures by which the costs of one sample in several domains become one cost."""

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
    """As many as look :data:`AHEAD` ahead."""


AHEAD = 1.0
"""How far ``horizon = "auto"`` looks ahead [s]."""


def _number_or_flag(value: object) -> str:
    return "flag" if isinstance(value, bool) else "number"


def _number_or_text(value: object) -> str:
    return "text" if isinstance(value, str) else "number"


Kept = Annotated[Annotated[Flag, Tag("flag")] | Annotated[Natural, Tag("number")], Discriminator(_number_or_flag)]

Samples = Annotated[
    Annotated[TwoOrMore, Tag("number")] | Annotated[SampleCount, Tag("text")], Discriminator(_number_or_text)
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
    Annotated[Positives, Tag("numbers")] | Annotated[Growing, Tag("table")], Discriminator(_numbers_or_table)
]


class Refinement(StrEnum):
    """Methods by which derivatives improve a plan."""

    GRADIENT = "gradient"
    ILQG = "ilqg"


class Refine(Section):
    """Improvement of the samples' plan by derivatives.

    They are finite differences of the engine's physics and of the residuals of the costs, along the plan's own rollout.
    """

    method: Refinement
    """``gradient``: steepest descent on the knots, or ``ilqg``: a quadratic model solved from the end to the start,
    with a feedback gain for every control that plans are followed with."""
    iterations: Count = 1
    """Expansions, each followed by a line search."""
    candidates: TwoOrMore = 8
    """Step sizes of a line search, tried at once: none, and from one down to a thousandth."""


DIRECT = frozenset({Method.ILQG, Method.ILQS})
"""Methods whose plans are the controls themselves, whatever ``planner.knots`` says: iLQG solves for them. They are held
where the scene's spline is a smooth one."""

PRESETS = {
    Method.GRADIENT_DESCENT: {"refine": {"method": "gradient"}},
    Method.ILQG: {"refine": {"method": "ilqg"}},
    Method.ILQS: {"refine": {"method": "ilqg"}},
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
the cross-entropy method with what Pinneri et al. (CoRL 2020) add to it. The last three are MuJoCo MPC's planners with
derivatives (2212.00541)."""


class Planner(Section):
    """The sampling-based planner."""

    method: Method = Method.MPPI
    """Strategy of the plans, a registered one among them."""
    samples: Samples = 256
    """Candidate control sequences S, or ``auto``: as many as fit into a control on this machine, measured by
    ``warpmpc run`` and ``warpmpc.fit_samples``."""
    horizon: Horizon = 16
    """Steps T of a rollout, or ``auto``: as many as look 1 s ahead, the median of the shipped scenes, or as ``dt``
    lists. How far to look is up to the task and not to the machine: ``samples`` alone are measured."""
    dt: Steps | None = None
    """Length of the steps of a rollout [s]: one number, one for each step, or a table (see ``Growing``);
    ``timing.control_dt`` when left out. Longer steps look further ahead at the same price."""
    domains: Count = 1
    """Draws D of physical properties each sample is tried in; S·D rollouts. With 1, every sample has its own draw."""
    randomize: Flag = True
    """Whether the rollouts' worlds have the randomized properties of ``[randomize]``; when false all are nominal."""
    risk: Risk = Risk.MEAN
    """Risk measures by which the costs of one sample in several domains become one cost."""
    cvar: Share = 0.25
    """Share of worst domains that ``risk = "cvar"`` averages and of which ``risk = "var"`` takes the mildest."""
    aversion: Finite = 1.0
    """R of ``risk = "exponential"``, log(mean e^{R S})/R, per unit of cost; zero is the mean."""
    stage_risk: Finite = 0.0
    """R of ρ(l; R) = (e^{R l} - 1)/R, which every step's cost l, summed over the terms, goes through; zero is l itself
    [M5]. Positive ones shun single bad steps, negative ones bound what a step can cost by -1/R."""
    knots: TwoOrMore | None = None
    """Spline control points P; one per step when left out, and always for ``ilqg`` and ``ilqs``."""
    spline: SplineKind = SplineKind.ZERO
    """Splines by which knots become controls."""
    discount: Share = 0.95
    """Factor γ per step of a rollout [P5]."""
    terminal: NonNegative = 1.0
    """Factor on the last step's cost, besides its discount."""
    noise: Noise = Noise()
    """What samples differ from the mean by."""
    temperature: Temperature = Temperature()
    """How strongly cheap samples are preferred."""
    step_size: Share = 1.0
    """Step α of the mean towards the weighted samples [S4]."""
    covariance: Covariance = Covariance()
    """What becomes of the covariance of the samples."""
    keep_best: Kept = 0
    """How many of the best samples so far, moved on by the time that has passed, are tried again among the samples;
    ``true`` is one."""
    try_mean: TryMean = TryMean.ALWAYS
    """In which iterations the mean itself is one of the samples."""
    sequences: str | None = None
    """File of control sequences that are tried at every plan, one sample each: ``.npy`` or ``.npz`` with
    ``[n, T or P, nu]``, or ``.csv`` with a sequence on each line, step by step."""
    postures: Postures | None = None
    """Ways of the joints to postures that bring a frame to a pose, tried at every plan, too."""
    ancillary: Annotated[tuple[Ancillary, ...], OneOrMore] = ()
    """What proposes samples for the observed state, at every plan: functions of your own, stored motions, policies."""
    refine: Refine | None = None
    """What derivatives make of the samples' plan. ``gradient_descent`` and ``ilqg`` are this without samples, ``ilqs``
    is ``predictive_sampling`` with ``ilqg``."""
    execute: Execute = Execute.MEAN
    """What is carried out: the mean, or the best of the last samples."""
    iterations: Count = 1
    """Sample-roll-out-update rounds per plan."""
    decay: Annotated[Positive, Field(ge=1.0)] = 1.0
    """γ of a population that decays: iteration i tries S/γ^i samples, but no fewer than twice the ``elites``."""
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
        method = data.get("method") if isinstance(data, dict) else None
        preset = PRESETS.get(method) if isinstance(method, str) else None
        if preset is None:
            return handler(data)
        tables = {key: value for key, value in preset.items() if isinstance(value, dict)}
        merged = {key: {**own, **data[key]} for key, own in tables.items() if isinstance(data.get(key), dict)}
        out = {**preset, **data, **merged}
        if method in DIRECT:
            smooth = out.get("spline") in (SplineKind.CUBIC, SplineKind.BSPLINE)
            out |= {"knots": None} | ({"spline": SplineKind.ZERO} if smooth else {})
        planner = handler(out)
        planner.__pydantic_fields_set__.intersection_update(data)
        return planner

    @model_validator(mode="after")
    def _steps(self) -> Planner:
        if self.horizon is StepCount.AUTO:
            if isinstance(self.dt, Growing):
                raise ValueError('horizon = "auto" does not go with steps that grow: give horizon a number')
        elif isinstance(self.dt, tuple) and len(self.dt) not in (1, self.horizon):
            raise ValueError(f"dt has one number, or {self.horizon}: one for each step of the horizon")
        return self

    def steps_ahead(self, control_dt: float) -> int:
        """The horizon that ``auto`` stands for, with controls of a length [s]."""
        dt = self.dt or (control_dt,)
        return len(dt) if len(dt) > 1 else max(1, math.ceil(AHEAD / dt[0] - 1e-9))

    @model_validator(mode="after")
    def _domains_differ(self) -> Planner:
        if self.domains > 1 and not self.randomize:
            raise ValueError("domains > 1 tries samples in different worlds: set randomize = true or domains = 1")
        return self


class EngineName(Name):
    """Engines of rollouts."""

    AUTO = "auto"
    MUJOCO = "mujoco"
    NEWTON = "newton"
    KINEMATIC = "kinematic"
    FUSED = "fused"

    @classmethod
    def registry(cls) -> Registry:
        """Registry of users' engines."""
        return ENGINES


class Solver(StrEnum):
    """Newton solvers of the engine ``newton``."""

    MUJOCO = "mujoco"
    XPBD = "xpbd"
    FEATHERSTONE = "featherstone"
    SEMI_IMPLICIT = "semi_implicit"
    STEEL = "steel"
    KAMINO = "kamino"


class Integrator(StrEnum):
    """Integrators by which MuJoCo moves on from accelerations to velocities and positions."""

    EULER = "euler"
    RK4 = "rk4"
    IMPLICIT = "implicit"
    IMPLICITFAST = "implicitfast"


class Cone(StrEnum):
    """MuJoCo's friction cone."""

    PYRAMIDAL = "pyramidal"
    ELLIPTIC = "elliptic"


class EngineSettings(Section):
    """The physics of the rollouts.

    What is left out is as the ``<option>`` of the scene's first MJCF file says, or as said here where there is none.
    """

    name: EngineName = EngineName.AUTO
    """Engine of the rollouts, a registered one among them; ``auto``: the first that can do what the scene asks for."""
    substeps: Count | None = None
    """Physics steps per control; else as many as the MJCF file's timestep asks for, or 2."""
    threads: Natural = 0
    """CPU threads; 0 means one per core."""
    iterations: Count | None = None
    """Largest number of constraint solver iterations; else the MJCF file's, or 20."""
    tolerance: NonNegative | None = None
    """Constraint solver tolerance; else the MJCF file's, or 1e-6."""
    integrator: Integrator | None = None
    """Of the rollouts and of the plant; else the MJCF file's, or ``implicitfast``."""
    cone: Cone | None = None
    """Friction cone of the rollouts and of the plant; else the MJCF file's, or ``pyramidal``."""
    impratio: Positive | None = None
    """Ratio of friction to normal impedance of contacts, of rollouts and plant; else the MJCF file's, or 1."""
    solver: Solver = Solver.MUJOCO
    """``newton``: which of Newton's solvers."""
    options: dict[str, Param] = Field(default_factory=dict)
    """``newton``: further options, passed to the solver's constructor by name."""
