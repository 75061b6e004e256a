# SPDX-License-Identifier: Apache-2.0
"""The types of what ends a run: conditions, success, failures."""

from __future__ import annotations

from typing import Annotated

from pydantic import model_validator

from .types import Finite, Name, NonNegative, OneOrMore, Positive, Positives, Section


class Condition(Section):
    """Something that must hold: of a frame, a joint or the value of a cost term."""

    frame: str | None = None
    """Frame (``robot/frame``, ``robot/link``, an object) whose distance from ``to`` or whose height is looked at."""
    to: str = "goal"
    """``frame``: what it is compared with, a frame or a target."""
    distance: Positive | None = None
    """``frame``: largest distance [m]."""
    yaw: Positive | None = None
    """``frame``: largest heading error [rad]."""
    rotation: Positive | None = None
    """``frame``: largest angle between the orientations [rad]."""
    joint: str | None = None
    """Joint, ``robot/joint`` or its own name, whose position is looked at [m or rad]."""
    term: str | None = None
    """Cost term by its name in printouts, whose value without its weight is looked at."""
    above: Finite | None = None
    """Least value of the joint or term, least height of the frame [m]."""
    below: Finite | None = None
    """Largest value of the joint or term, largest height of the frame [m]."""

    @model_validator(mode="after")
    def _one_subject(self) -> Condition:
        if sum(subject is not None for subject in (self.frame, self.joint, self.term)) != 1:
            raise ValueError("a condition is about one of frame, joint, term")
        errors = [self.distance, self.yaw, self.rotation]
        if self.frame is None and any(error is not None for error in errors):
            raise ValueError("distance, yaw and rotation belong to a condition about a frame")
        if all(bound is None for bound in (*errors, self.above, self.below)):
            raise ValueError("a condition needs above or below; one about a frame may have distance, yaw, rotation")
        return self


class Success(Section):
    """Conditions on which the run has reached its goal."""

    position: Positives | None = None
    """Largest error along each axis of the world [m]: one number, or one for every axis of the goal."""
    distance: Positive | None = None
    """Largest Euclidean error [m]."""
    yaw: Positive | None = None
    """Largest heading error [rad]."""
    rotation: Positive | None = None
    """Largest rotation angle to the goal orientation [rad]."""
    conditions: Annotated[tuple[Condition, ...], OneOrMore] = ()
    """What must hold besides, of frames, joints or cost terms; a scene without a goal has these alone."""
    hold: NonNegative = 0.0
    """Time for which all of it must hold [s]."""

    @property
    def of_goal(self) -> bool:
        """Return whether it compares anything with the goal."""
        return any(limit is not None for limit in (self.position, self.distance, self.yaw, self.rotation))

    @model_validator(mode="after")
    def _something(self) -> Success:
        if not self.of_goal and not self.conditions:
            raise ValueError("success needs at least one of position, distance, yaw, rotation, conditions")
        return self


class Failure(Section):
    """Something that ends the run without success: what must not come, what takes too long."""

    name: Name
    """What the result calls it."""
    conditions: Annotated[tuple[Condition, ...], OneOrMore] = ()
    """The run fails when all of these hold; with none of them, when the time ``after`` has passed."""
    hold: NonNegative = 0.0
    """... for this time [s]."""
    phase: str | None = None
    """The phase in which it counts, of several goals each, or one by its number (``NAME_1``); the whole run when left
    out."""
    after: NonNegative = 0.0
    """It counts from this time after the beginning of the phase, or of the run, on [s]."""

    @model_validator(mode="after")
    def _something(self) -> Failure:
        if not self.conditions and not self.after:
            raise ValueError("a failure needs conditions, or a time after which a phase takes too long")
        return self
