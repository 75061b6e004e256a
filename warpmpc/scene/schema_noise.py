# SPDX-License-Identifier: Apache-2.0
"""The types of noise and temperature: how samples differ from the mean, and how strongly cheap ones count."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from pydantic import Discriminator, Field, Tag, model_validator

from .types import Channel, Count, Flag, Fraction, NonNegative, Positive, Positives, Section, Vec3


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
