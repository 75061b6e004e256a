# SPDX-License-Identifier: Apache-2.0
"""The types of what is drawn: properties of worlds, and the task of an episode."""

from __future__ import annotations

from pydantic import Field, field_validator, model_validator

from .types import Flag, Floats, Fraction, NonNegative, Section, Vec3


class Uniform(Section):
    """A fraction of the nominal value, uniform in ± ``uniform``."""

    uniform: Fraction
    """Largest deviation, as a fraction of the nominal value."""
    ends: Flag = False
    """Whether it is off by the whole of it always, up or down."""


class Normal(Section):
    """A Gaussian with standard deviation ``normal``."""

    normal: NonNegative
    """Standard deviation [m]."""


class Randomization(Section):
    """Random physical properties of one robot, object or obstacle, drawn per world."""

    mass: Uniform | None = None
    """Factor on every mass."""
    friction: Uniform | None = None
    """Factor on every coefficient of friction."""
    size: Normal | None = None
    """Added to each dimension [m]."""
    redraw: Flag = False
    """Whether rollouts draw it anew in every plan."""


class Draw(Section):
    """Uniform draw of a scene key at the start of an episode."""

    low: Floats
    """Least value, in the unit of the key that is drawn: one, or one for each of its numbers."""
    high: Floats
    """Largest value, likewise."""

    @model_validator(mode="after")
    def _ordered(self) -> Draw:
        if len(self.low) != len(self.high) or any(lo > hi for lo, hi in zip(self.low, self.high, strict=False)):
            raise ValueError("a draw needs low = [...] and high = [...] of one length with low ≤ high")
        return self


class Rejection(Section):
    """Draws in which a place lies too close to an obstacle are drawn again."""

    place: str
    """``goal``, an object, a robot (the start position of its root), or a robot frame (``robot/frame``) with ``at``."""
    at: Vec3 | None = None
    """Where the place is at the start [m], for robots whose joints carry them away from their root."""
    clearance: NonNegative
    """Least distance from the obstacles' surfaces [m]."""


class RandomizeTask(Section):
    """Goals, starts and obstacles drawn anew for every episode, from its seed."""

    draw: dict[str, Draw] = Field(default_factory=dict)
    """Scene key (as in ``--set``, ``*`` for every name) → range; in a variant, false leaves one out."""
    reject: tuple[Rejection, ...] = ()
    """Which draws are drawn again."""

    @field_validator("draw", mode="before")
    @classmethod
    def _left_out(cls, draw: object) -> object:
        return {key: value for key, value in draw.items() if value is not False} if isinstance(draw, dict) else draw
