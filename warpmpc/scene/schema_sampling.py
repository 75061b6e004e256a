# SPDX-License-Identifier: Apache-2.0
"""The types of noise and temperature: how samples differ from the mean, and how strongly cheap ones count.

The types of what samples are drawn from and of what becomes of them.

The types of what proposes samples beside those that are drawn.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from pydantic import Discriminator, Field, Tag, model_validator

from .types import (
    Channel,
    Count,
    Flag,
    Fraction,
    Fractions,
    Names,
    NonNegative,
    NonNegatives,
    Positive,
    Positives,
    Section,
    Share,
    Vec3,
)


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


def numbers_or_table(value: object) -> str:
    """Tag of numbers, or of a table in their place."""
    return "table" if isinstance(value, dict | Section) else "numbers"


Sigma = Annotated[
    Annotated[Positives, Tag("numbers")] | Annotated[ShareOfRange, Tag("table")], Discriminator(numbers_or_table)
]


class Noise(Section):
    """Noise of the knots, ε = σ ⊙ (B z)."""

    source: NoiseSource = NoiseSource.HALTON
    """Source of the standard normal numbers z."""
    shape: NoiseShape = NoiseShape.IDENTITY
    """How they are correlated along the horizon, B."""
    sigma: Sigma = ShareOfRange(range=(0.25,))
    """Standard deviation in control units, one value or one per control; or a share of each control's range, by default
    ``{ range = 0.25 }``, less for controls that turn a robot over before the next knot (see ``warpmpc check``)."""
    spread: tuple[Positive, Positive] = (0.02, 1.0)
    """Factors (low, high) on sigma, increasing over the samples: one batch searches near and far."""
    constant: Channel = 0.1
    """Share of the samples with the same noise at every knot: steady motions, which independent knots rarely draw."""
    redraw: Flag = True
    """Draw noise in every round; false draws it once, as in the papers."""
    renewal: Renewal = Renewal.ROTATE
    """How to redraw a Halton or Sobol table: ``rotate`` adds a random number modulo one to every column, ``start``
    begins every column at a random row, in a tenth of the time."""
    comb: Vec3 = (0.3, 0.0, 0.7)
    """Coefficients of the comb filter (STORM)."""
    exponent: NonNegative = 1.0
    """Exponent α of coloured noise, power ∝ 1/f^α."""
    knots: Count | None = None
    """Noise knots of the shape ``bspline``, fewer are smoother; half of the plan's knots when left out."""
    null_sample: Flag = True
    """One sample holds still: the observed position, or the control that holds the start; else zero."""
    null_share: Fraction = 0.0
    """Share of the samples that hold still, if more than one: an arm near its goal stops (STORM)."""
    anneal: tuple[Positive, Positive] | None = None
    """β1 and β2 of DIAL-MPC: σ shrinks by exp(-i/(β1 n)) over the iterations i < n and by exp(-(1 - h)/β2) along the
    plan, h from 1/P at the first of P knots to 1 at the last."""


class Temperature(Section):
    """Temperature β of MPPI's weights exp(-ΔS/β)."""

    initial: Positive = 1.0
    """β in units of cost: of the first plan with ``eta``, of every plan without ``eta`` and ``ess``."""
    eta: tuple[Positive, Positive] | None = None
    """Bounds of the effective number of samples η, instead of ``ess``; β follows them between plans [P6]. When
    false, β stays."""
    ess: Annotated[Positive, Field(ge=1.0)] | None = 4.0
    """Effective sample size (Σw)²/Σw² that β is solved for within each plan."""

    @model_validator(mode="before")
    @classmethod
    def _eta_replaces_default_ess(cls, data: object) -> object:
        return {"ess": None, **data} if isinstance(data, dict) and "eta" in data else data

    @model_validator(mode="after")
    def _ordered(self) -> Temperature:
        if self.eta is not None and self.ess is not None:
            raise ValueError("only one of eta and ess can steer the temperature: switch one off, as in eta = false")
        if self.eta is not None and self.eta[0] >= self.eta[1]:
            raise ValueError(f"eta = [low, high] needs low < high; found {list(self.eta)}")
        return self


class CovarianceForm(StrEnum):
    """Parts of the samples' covariance that follow those that carry weight [S5]."""

    FIXED = "fixed"
    """Nothing."""
    DIAGONAL = "diagonal"
    """One σ for every control (STORM's code)."""
    KNOTS = "knots"
    """One σ for every control at every knot; with ``knots = "steps"`` the diagonal of Σ_h."""
    FULL = "full"
    """One covariance of all controls, the same at every knot."""
    FULL_KNOTS = "full_knots"
    """A covariance of all controls at every knot; with ``knots = "steps"`` it is Σ_h itself."""


class Covariance(Section):
    """Adaptation of the samples' covariance."""

    form: CovarianceForm | None = None
    """What adapts to the weighted samples; by default ``knots`` for ``cem`` and ``icem``, else ``fixed``."""
    step_size: Share | None = None
    """Step α_σ of the covariance towards the spread of the weighted samples [S5]; ``planner.step_size`` if left out."""
    kappa: NonNegatives = (0.0,)
    """Variance κ that is added at every plan, in control units squared, one value or one per control."""
    restart: Flag = False
    """Whether every plan begins with ``noise.sigma`` again."""


class Postures(Section):
    """Samples that bring a frame to a pose: straight joint motions to postures found by inverse kinematics."""

    of: str
    """Frame of a robot."""
    to: str = "goal"
    """The goal or a target."""
    count: Count = 8
    """Number of postures that are searched for; the worst is replaced in every plan."""
    durations: Annotated[tuple[Positive, ...], Field(min_length=1)] = (0.5, 0.8, 1.2, 1.8)
    """Durations of the motions [s]: one sample for each, to every posture."""


class Execute(StrEnum):
    """Part of a plan that is carried out."""

    MEAN = "mean"
    BEST = "best"
    SAMPLE = "sample"
    """One drawn about the mean, with the covariance as the last samples have left it."""


class TryMean(StrEnum):
    """Cases in which the mean is one of the samples."""

    ALWAYS = "always"
    """In every iteration."""
    LAST = "last"
    """In the last one alone: until then samples would narrow about it early (iCEM)."""


KINDS = {
    "function": (),
    "motions": ("nearest", "joints"),
    "recall": ("nearest", "joints", "splice"),
    "policy": ("observation",),
}
"""What may propose, and the keys that each of them has for itself."""


class Ancillary(Section):
    """Samples proposed for the observed state by a function, stored motions, past controls or a policy."""

    function: str | None = None
    """Name of your own ancillary controller (``@warpmpc.ancillary``), from a file of ``--terms`` or given to the
    ``Controller``."""
    motions: str | None = None
    """``.npz`` file of motions: ``joint_q [N, nq]``, ``joint_qd [N, nv]``, ``control [N, K, nu]`` at ``time [K]`` after
    each state [s]; or a run of ``--npz``, from any of its states on."""
    recall: Positive | None = None
    """How long states and controls are remembered [s], in runs with a plan for every control. Controls that followed
    the most similar states are tried again: a walking robot was in a similar state one stride ago."""
    nearest: Count = 1
    """``motions`` and ``recall``: number of nearest states that are tried; recalled ones at least a tenth of the
    horizon apart."""
    joints: Names | None = None
    """``motions`` and ``recall``: joints whose positions and velocities are compared, scaled by their spread; all when
    left out (for ``recall`` without positions of free bodies and unlimited slides)."""
    splice: Fractions = (0.0, 0.3, 0.6)
    """``recall``: shares of the horizon that keep the current plan before the recalled controls; one sample for each
    share and each of the ``nearest``."""
    policy: str | None = None
    """``.onnx`` file of a policy, run by onnxruntime (``pip install "warpmpc[onnx]"``)."""
    observation: Names = ("joint_q", "joint_qd")
    """``policy``: its input, concatenated: ``joint_q``, ``joint_qd``, ``act``, poses (x, y, z, qx, qy, qz, qw) and
    scalars of the task by name. It returns one control ``[nu]``, or controls ``[T, nu]`` or ``[n, T, nu]``."""

    @model_validator(mode="after")
    def _one_kind(self) -> Ancillary:
        given = [kind for kind in KINDS if getattr(self, kind) is not None]
        if len(given) != 1:
            found = ", ".join(given) if given else "none of them"
            raise ValueError(f"needs one of function, motions, recall and policy; found {found}")
        for kind, keys in KINDS.items():
            for key in keys:
                if key not in KINDS[given[0]] and getattr(self, key) != type(self).model_fields[key].default:
                    raise ValueError(f"'{key}' is a key of {kind}, not of {given[0]}")
        return self

    @property
    def file(self) -> str | None:
        """The file it is read from, if any."""
        return self.motions or self.policy
