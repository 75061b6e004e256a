# SPDX-License-Identifier: Apache-2.0
"""The types of what moves by itself while a run goes on."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated

from pydantic import Field, model_validator

from .types import Finite, NonNegative, Positive, Section, Vec3


class Seen(Section):
    """Observation of something that moves."""

    rate: Positive | None = None
    """Observations a second [1/s]; one for every control when left out."""
    noise: NonNegative = 0.0
    """Standard deviation of every observed coordinate [m]."""
    lead: NonNegative = 0.0
    """How far ahead of the present the planner is shown it, on a straight line through what was observed last [s];
    0 shows the last observation as it was."""
    over: Positive = 0.3
    """Time of the observations that the line is laid through [s]."""


class Motion(Section):
    """The way of a pose of the task in a simulated plant: the goal, a target or a movable obstacle."""

    name: str
    """``goal``, or the target or movable obstacle."""
    through: Annotated[tuple[Vec3, ...], Field(min_length=2)]
    """Points that it passes through, smoothly and without overshooting [m]; equal ones make it wait."""
    times: tuple[NonNegative, ...] | None = None
    """When it is at each of them [s], from 0 on; at even distances over the period when left out."""
    period: Positive | None = None
    """Time after which it is back at the first point and goes round again [s]; else it stays at the last."""
    start: Finite = 0.0
    """When it sets out [s]; below zero it is on its way from the beginning."""
    seen: Seen = Seen()
    """How the planner comes to know where it is."""

    @model_validator(mode="after")
    def _in_order(self) -> Motion:
        times, period = self.times, self.period
        if times is None:
            if period is None:
                raise ValueError("a motion needs a period, or times of its points")
            return self
        if len(times) != len(self.through):
            raise ValueError(f"there are {len(self.through)} points and {len(times)} times")
        if times[0] != 0.0 or any(a >= b for a, b in pairwise(times)):
            raise ValueError("times begin with 0 and grow")
        if period is not None and period <= times[-1]:
            raise ValueError("the period ends after the last of the times")
        return self
