# SPDX-License-Identifier: Apache-2.0
"""Poses of goals and targets, and the phases of a task.

The types of what ends a run: conditions, success, failures.

Phases whose goal goes through several poses: one phase each.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Annotated

from pydantic import Field, model_validator

from .types import Count, Finite, Flag, Name, NonNegative, OneOrMore, Positive, Positives, Quat, Section, Vec2or3

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence


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
    """The run fails when all of these hold; without any, when the time ``after`` has passed."""
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


class Pose(Section):
    """A place, with or without an orientation."""

    position: Vec2or3 = (0.0, 0.0, 0.0)
    """(x, y) or (x, y, z) [m]; with two values the height does not matter."""
    yaw: Finite | None = None
    """Heading about z [rad]."""
    rotation: Quat | None = None
    """Full orientation (x, y, z, w) instead of a yaw."""

    @model_validator(mode="after")
    def _one_orientation(self) -> Pose:
        if self.yaw is not None and self.rotation is not None:
            raise ValueError("give yaw or rotation, not both")
        return self


class Target(Pose):
    """A named pose that may change between plans, a frame for cost terms: a waypoint, what a camera sees."""

    name: Name
    """What cost terms, conditions and ``task[...]`` call it."""


class Goal(Pose):
    """Pose that an object or a frame shall have."""

    object: str | None = None
    """Object that shall reach the goal."""
    frame: str | None = None
    """Robot frame (``robot/frame``) that shall reach the goal, instead of an object."""

    @model_validator(mode="after")
    def _one_target(self) -> Goal:
        if (self.object is None) == (self.frame is None):
            raise ValueError("a goal names either object or frame")
        return self

    @property
    def target(self) -> str:
        """Name of the frame that shall reach the goal."""
        return self.object or self.frame


class Phase(Section):
    """A part of a task with its own targets, scalars and weights; it ends when what it waits for has come."""

    name: Name
    """What ``--json`` and ``Monitor.phases`` call it."""
    goal: Pose | None = None
    """Where the goal is in this phase; where it was when left out."""
    through: Annotated[tuple[Pose, ...], OneOrMore] = ()
    """Goals one after the other in place of one; ``until``, ``hold`` and ``after`` hold for each, a phase NAME_1 ..."""
    count: Count | None = None
    """So many goals one after the other, as with ``through``, at one place: turned anew with ``draw_rotation``."""
    draw_rotation: Flag = False
    """Whether every episode draws the goal's orientation, of all there are, those of ``through`` and ``count`` too."""
    target: dict[Name, Pose] = Field(default_factory=dict)
    """Targets that are elsewhere in this phase."""
    scalar: dict[Name, Finite] = Field(default_factory=dict)
    """Scalars that have another value in this phase."""
    weight: dict[str, Finite] = Field(default_factory=dict)
    """Weights of cost terms in this phase; 0 switches a term off."""
    until: Annotated[tuple[Condition, ...], OneOrMore] = ()
    """The phase ends when all of these hold; the last phase has none and ends with the run."""
    hold: NonNegative = 0.0
    """... for this time [s]."""
    after: Positive | None = None
    """The phase ends after this time [s], whatever holds."""

    @model_validator(mode="after")
    def _one_kind_of_goal(self) -> Phase:
        given = [name for name in ("goal", "through") if getattr(self, name)]
        if len(given) == 2 or (self.through and self.count is not None):
            raise ValueError("a phase has a goal, with a count or without, or goes through several")
        if (self.count is not None or self.draw_rotation) and not given:
            raise ValueError("count and draw_rotation are about goals: give goal or through")
        if self.draw_rotation and any(pose.yaw is not None for pose in (self.goal, *self.through) if pose is not None):
            raise ValueError("draw_rotation takes the place of yaw")
        return self


def one_by_one(phases: Sequence[Phase]) -> tuple[Phase, ...]:
    """Phases with one goal each: ``NAME_1``, ``NAME_2``, ... in place of one with several.

    The last goal of the last phase is the run's: it ends with success, not with a condition.
    """
    out: list[Phase] = []
    for phase in phases:
        goals = phase.through or (phase.goal,) * (phase.count or 1)
        if len(goals) == 1 and not phase.through and phase.count is None:
            out.append(phase)
            continue
        for i, goal in enumerate(goals):
            change = {"name": f"{phase.name}_{i + 1}", "goal": goal, "through": (), "count": None}
            out.append(phase.model_copy(update=change))
        if phase is phases[-1]:
            out[-1] = out[-1].model_copy(update={"until": (), "hold": 0.0, "after": None})
    return tuple(out)


def is_of(phase: str, name: str) -> bool:
    """Return whether a phase has this name, or is one of the several goals of a phase that has it: ``NAME_1``, ..."""
    return re.fullmatch(rf"{re.escape(name)}(_\d+)?", phase) is not None


def runs_of(phases: Iterable[str]) -> list[tuple[str, str]]:
    """First and last of the names that follow one another as ``NAME_1``, ``NAME_2``, ..., in their order."""
    out: list[tuple[str, str]] = []
    for phase in phases:
        base, _, number = phase.rpartition("_")
        if out and number.isdecimal() and out[-1][1] == f"{base}_{int(number) - 1}":
            out[-1] = (out[-1][0], phase)
        else:
            out.append((phase, phase))
    return out
