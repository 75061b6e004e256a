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
    """Perturbation of the knots, ε = σ ⊙ (B z)."""

    source: NoiseSource = NoiseSource.HALTON
    """Where standard normals z come from."""
    shape: NoiseShape = NoiseShape.IDENTITY
    """How they are correlated along the horizon, B."""
    sigma: Sigma = ShareOfRange(range=(0.25,))
    """Standard deviation in control units, one value or one per control; or ``{ range = 0.25 }``, by each control's
    range, as when left out."""
    spread: tuple[Positive, Positive] = (0.02, 1.0)
    """Factors (low, high) on sigma: samples run from one to the other, so that one batch searches near and far."""
    constant: Channel = 0.1
    """Share of the samples whose noise is the same at every knot: gentle, steady motions, which independent knots of
    several controls hardly ever draw."""
    redraw: Flag = True
    """Fresh noise in every round; when false it is drawn once, as in the papers."""
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
    """One sample asks for nothing: the observed position, or what holds the start; zero where nothing does."""
    null_share: Fraction = 0.0
    """Share of the samples that ask for nothing, where that is more than the one: an arm that is nearly there coasts
    and stops (STORM)."""
    anneal: tuple[Positive, Positive] | None = None
    """β1 and β2 of DIAL-MPC: σ shrinks by exp(-i/(β1 n)) over the iterations i < n and by exp(-(1 - h)/β2) towards the
    present, h from 1/P at the first of P knots to 1 at the last."""


class Temperature(Section):
    """The inverse-exponential temperature β of MPPI."""

    initial: Positive = 1.0
    """β of the first plan with ``eta``, of every plan with neither, in units of cost; ``ess`` finds its own."""
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
    """What follows the samples that carry weight; ``knots`` for ``cem`` and ``icem``, ``fixed`` else, when left out."""
    step_size: Share | None = None
    """Step α_σ of the covariance towards the spread of the weighted samples [S5]; ``planner.step_size`` if left out."""
    kappa: NonNegatives = (0.0,)
    """Variance κ that is added whenever the plan moves on, in control units squared, one value or one per control."""
    restart: Flag = False
    """Whether every plan begins with ``noise.sigma`` anew, so that what is adapted lasts for its iterations alone."""


class Postures(Section):
    """Samples that bring a frame to a pose: straight ways of the joints to postures in which it is there."""

    of: str
    """Frame of a robot."""
    to: str = "goal"
    """The goal or a target."""
    count: Count = 8
    """Postures that are searched for at a time; the worst makes room for others, again and again."""
    durations: Annotated[tuple[Positive, ...], Field(min_length=1)] = (0.5, 0.8, 1.2, 1.8)
    """How long the ways take [s]: one sample for each of these to every posture."""


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
    """Samples that something else proposes for the observed state: a function, stored motions, the past, a policy."""

    function: str | None = None
    """Name of your own ancillary controller (``@warpmpc.ancillary``), from a file of ``--terms`` or given to the
    ``Controller``."""
    motions: str | None = None
    """``.npz`` file of motions: ``joint_q [N, nq]``, ``joint_qd [N, nv]``, ``control [N, K, nu]``, ``time [K]`` after
    each of these states [s]; or a run that ``--npz`` wrote, from any of its states on."""
    recall: Positive | None = None
    """How long a run remembers what it was sent and in which states, with a plan for every control [s]: what followed
    the states most like the observed one is tried again. A walking robot was in a similar state one stride ago."""
    nearest: Count = 1
    """``motions`` and ``recall``: how many are tried, those whose states are nearest to the observed one; recalled ones
    a tenth of the horizon apart at least."""
    joints: Names | None = None
    """``motions`` and ``recall``: joints whose positions and velocities say what is near; all when left out, without
    the places of floating bodies and of joints that slide without end for ``recall``. Each number counts by its
    spread over what is stored."""
    splice: Fractions = (0.0, 0.3, 0.6)
    """``recall``: shares of the horizon for which the plan goes on as it was before the recalled controls take over;
    each is a separate sample for every one of the ``nearest``."""
    policy: str | None = None
    """``.onnx`` file of a policy, run by onnxruntime (``pip install "warpmpc[onnx]"``)."""
    observation: Names = ("joint_q", "joint_qd")
    """``policy``: what it reads, side by side: ``joint_q``, ``joint_qd``, ``act``, poses of the task (x, y, z, qx, qy,
    qz, qw) and its scalars, by name. It returns one control ``[nu]``, or controls ``[T, nu]`` or ``[n, T, nu]``."""

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
