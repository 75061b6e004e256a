# SPDX-License-Identifier: Apache-2.0
"""Poses of goals and targets, and the phases of a task."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from .schema_over import Condition
from .types import Count, Finite, Flag, Name, NonNegative, OneOrMore, Positive, Quat, Section, Vec2or3


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
    """A part of a task with targets, scalars and weights of its own; it ends when what it waits for has come."""

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
