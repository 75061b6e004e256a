# SPDX-License-Identifier: Apache-2.0
"""The keys of residual terms in scene files."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from ..scene.types import Finite, NonNegative, OneOrSeveral, Section
from .norms import NormKey, NormKind


class CentreOfMass(Section):
    """A place that no frame marks."""

    centre_of_mass: str
    """Robot, object, or ``robot/link`` with all that hangs on it."""


Place = Annotated[tuple[str | CentreOfMass, ...], Field(min_length=1), OneOrSeveral]
"""A frame, or ``{ centre_of_mass = "robot" }``; of several the mean."""
Wanted = Annotated[tuple[Finite | str, ...], Field(min_length=1), OneOrSeveral]
"""One number or name of a scalar, or one for each of the residual's numbers."""
Axes = Annotated[str, Field(pattern="^(x?y?z?)$", min_length=1)]


class Residual(Section):
    """A residual and its norm."""

    target: Wanted | None = None
    """What the residual's numbers shall be: numbers or names of scalars, one or one for each; 0 when left out."""
    norm: NormKey = NormKind.QUADRATIC
    """quadratic, or { kind, p, q }: l2, l22, cosh, power, smooth_abs, smooth_abs2, rectify."""


class SpatialResidual(Residual):
    """A residual along axes of the world."""

    of: Place
    """Frame, or { centre_of_mass = "robot" }, or a list of such: their mean."""
    axes: Axes | None = None
    """Axes of the world that count, such as "xy"; all when left out, but for heights of goals that have none."""


class Position(SpatialResidual):
    """Where a place is [m]."""

    relative_to: Place | None = None
    """Place it is seen from, as ``of``; the world's origin when left out."""
    lead: NonNegative = 0.0
    """Look at where ``of`` would coast to in this time [s]."""


class Velocity(SpatialResidual):
    """How fast a place moves [m/s]."""

    relative_to: Place | None = None
    """Place whose velocity is taken off, as ``of``."""
