# SPDX-License-Identifier: Apache-2.0
"""The types of what samples are drawn from and of what becomes of them."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, ClassVar

from pydantic import Field

from .types import Count, Flag, Fraction, NonNegatives, Positive, Section, Share


class CovarianceForm(StrEnum):
    """Parts of the samples' covariance that follow those that carry weight [S5]."""

    FIXED = "fixed"
    """Nothing."""
    SIGMA = "sigma"
    """One σ for all controls and knots, Σ = σ²I."""
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

    renamed: ClassVar = {"ripe": "min_age"}

    of: str
    """Frame of a robot."""
    to: str = "goal"
    """The goal or a target."""
    count: Count = 8
    """Postures that are searched for at a time; the worst makes room for others, again and again."""
    durations: Annotated[tuple[Positive, ...], Field(min_length=1)] = (0.5, 0.8, 1.2, 1.8)
    """How long the ways take [s]: one sample for each of these to every posture."""
    steps: Count = 3
    """Steps of damped least squares towards the pose in every plan."""
    min_age: Count = 12
    """Plans for which a posture stays at least, before it may make room for another."""
    margin: Fraction = 0.05
    """Share of the range of every joint that postures keep away from its limits, both ends together."""


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
