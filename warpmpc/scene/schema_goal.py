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
    """When a run counts as successful."""

    position: Positives | None = None
    """Largest error along each axis of the world [m]: one number, or one for every axis of the goal."""
    distance: Positive | None = None
    """Largest Euclidean error [m]."""
    yaw: Positive | None = None
    """Largest heading error [rad]."""
    rotation: Positive | None = None
    """Largest rotation angle to the goal orientation [rad]."""
    conditions: Annotated[tuple[Condition, ...], OneOrMore] = ()
    """Further conditions on frames, joints or cost terms; the only ones in a scene without a goal."""
    hold: NonNegative = 0.0
    """Time for which all of them must hold [s]."""

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
    """A condition or a time that ends the run without success."""

    name: Name
    """Name in the result."""
    conditions: Annotated[tuple[Condition, ...], OneOrMore] = ()
    """The run fails when all of these hold; without any, when the time ``after`` has passed."""
    hold: NonNegative = 0.0
    """Time for which they must hold [s]."""
    phase: str | None = None
    """Phase in which it counts (with several goals all of them, or one as ``NAME_1``); the whole run when left out."""
    after: NonNegative = 0.0
    """It counts from this time on, since the beginning of the phase or of the run [s]."""

    @model_validator(mode="after")
    def _something(self) -> Failure:
        if not self.conditions and not self.after:
            raise ValueError("a failure needs conditions, or a time after which a phase takes too long")
        return self


class Pose(Section):
    """A place, with or without an orientation."""

    position: Vec2or3 = (0.0, 0.0, 0.0)
    """(x, y) or (x, y, z) [m]; with two values any height is right."""
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
    """Name in cost terms, conditions and ``task[...]``."""


class Goal(Pose):
    """Pose that an object or a frame has to reach."""

    object: str | None = None
    """Object that has to reach the goal."""
    frame: str | None = None
    """Robot frame (``robot/frame``) that has to reach the goal, in place of an object."""

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
    """A part of a task. What it changes stays changed in later phases."""

    name: Name
    """Name in ``--json`` and ``Monitor.phases``."""
    goal: Pose | None = None
    """Goal from this phase on; unchanged when left out."""
    through: Annotated[tuple[Pose, ...], OneOrMore] = ()
    """Successive goals, each a phase NAME_1, NAME_2, ... with the same ``until``, ``hold`` and ``after``."""
    count: Count | None = None
    """Number of successive goals at one position, as with ``through``; ``draw_rotation`` draws their orientations."""
    draw_rotation: Flag = False
    """Whether every episode draws the orientation of each goal, uniformly among all rotations."""
    target: dict[Name, Pose] = Field(default_factory=dict)
    """Poses of targets from this phase on."""
    scalar: dict[Name, Finite] = Field(default_factory=dict)
    """Values of scalars from this phase on."""
    weight: dict[str, NonNegative] = Field(default_factory=dict)
    """Weights of cost terms from this phase on; 0 switches a term off."""
    until: Annotated[tuple[Condition, ...], OneOrMore] = ()
    """The phase ends when all of these hold; the last phase has none and ends with the run."""
    hold: NonNegative = 0.0
    """Time for which ``until`` must hold [s]."""
    after: Positive | None = None
    """The phase ends after this time [s] in any case."""

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
