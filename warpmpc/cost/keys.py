# SPDX-License-Identifier: Apache-2.0
"""The keys of the built-in cost terms in scene files."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from pydantic import Field

from ..scene.types import (
    Finite,
    NonNegative,
    Positive,
    Section,
)


class Metric(StrEnum):
    """Measures of distances in the ground plane."""

    STRAIGHT = "straight"
    GEODESIC = "geodesic"


class Distance(Section):
    """Distance between two frames [m]."""

    between: tuple[str, str]
    """Two frames: [from, to]."""
    metric: Metric = Metric.STRAIGHT
    """straight, or geodesic: along the shortest path around the obstacles to the second frame."""
    planar: bool = False
    """Whether the height is left out; always so with the geodesic metric and for goals without a height."""
    inflation: NonNegative | None = None
    """Geodesic: obstacles grow by this for the mover's size [m]; from its shapes when left out."""
    near: NonNegative = 0.0
    """Saturate: 1 - exp(-d/near), a pull that acts within about this distance alone [m]; 0 means d itself."""
    lead: NonNegative = 0.0
    """Measure from where the first frame's body would coast to in this time [s]: for what rolls on by itself."""


class Yaw(Section):
    """Heading error of a frame [rad]."""

    of: str
    """Frame."""
    to: str = "goal"
    """Frame it is compared with."""
    near: NonNegative = 0.0
    """Fade: full weight at the target, 1/e of it at this distance [m]; 0 means the same weight everywhere."""
    smooth: NonNegative = 0.0
    """√(ψ² + p²) - p instead of |ψ| [rad]: errors below about p cost little, a push may turn the object a bit."""


class PushAlignment(Section):
    """cos α + 1: zero when the object lies between pusher and goal."""

    pusher: str
    """Frame that pushes."""
    object: str
    """Object that is pushed."""
    goal: str = "goal"
    """Frame it is pushed to."""
    metric: Metric = Metric.STRAIGHT
    """straight, or geodesic: the direction in which the path to the goal leaves the object."""
    inflation: NonNegative | None = None
    """Geodesic: obstacles grow by this for the object's size [m]."""
    near: NonNegative = 0.0
    """Fade: the term vanishes as the object comes closer to the goal than about this [m]."""
    slack: NonNegative = 0.0
    """max(cos α + 1 - slack, 0) instead: leaves the pusher a choice of places; 0.3 is about ± 45°."""


class PushPath(Section):
    """Work left to push an object to the goal around the obstacles [m]: pushes, and ways around the object."""

    pusher: str
    """Frame that pushes."""
    object: str
    """Object that is pushed, upright."""
    inflation: NonNegative | None = None
    """Obstacles grow by this for the object's size [m]; from its shapes when left out."""
    width: Positive
    """Room that the pusher needs across its direction of pushing [m]."""
    length: NonNegative
    """Room that the pusher needs behind its frame [m]."""
    behind: NonNegative = 0.0
    """How far the frame is behind the pusher's front [m]."""
    tolerance: NonNegative = 0.0
    """How far from the goal along each axis counts as there [m], for the last push; up to 4 times with ``steer``."""
    turn: Positive = 1.0
    """Cost of a metre around the object, relative to a metre of pushing."""
    steer: NonNegative = 0.0
    """Turn a box back: push beside its side's middle by this angle per heading error; at the goal, from there alone."""
    lead: NonNegative = 0.0
    """Look at where the object would coast to in this time [s]: for what rolls on by itself."""
    through: bool = False
    """With ``lead``: count an object that coasts through the goal as there, since it need not stop."""
    slant: Annotated[float, Field(ge=1.0)] = 1.5
    """How much dearer a push is at about 27° to a side's normal than square to it."""


class ContactForce(Section):
    """Sum of net contact forces [N]."""

    between: tuple[str, str]
    """Two entities or groups (obstacles, objects, robots)."""


class Robots(Section):
    """Controls or joints of one robot, or of all."""

    of: str | None = None
    """Robot; all when left out."""


class Joints(Section):
    """All joints of one robot, or joints by name."""

    of: str | None = None
    """Robot; the first when left out."""
    joints: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    """Joints, ``robot/joint`` or the joint's own name, in place of ``of``."""


class JointLimit(Section):
    """Squared distance outside the joint limits."""

    of: str | None = None
    """Robot; all when left out."""
    joints: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    """Joints with limits, ``robot/joint`` or the joint's own name, in place of ``of``."""
    margin: NonNegative = 0.05
    """Limits are moved inwards by this [m or rad]."""


class ObstacleClearance(Section):
    """Σ 1/d over the obstacles."""

    of: str
    """Frame."""
    to: str = "surface"
    """surface or centre of the obstacles."""
    radius: NonNegative = 0.0
    """Subtracted from the distance [m]."""
    least: Positive = 0.05
    """Shorter distances count as this [m]."""


class OutlineClearance(Section):
    """Nearness of a body's outline to the obstacles', seen from above: Σ max(0, 1 - d/within)."""

    of: str
    """Frame of the body, upright; its link's colliding shapes are its outline (their convex hull)."""
    within: Positive
    """Distances from here on cost nothing [m]."""


class OutlineDistance(Section):
    """Distance to the outline of an object seen from above [m]: least at its sides, not on top of it."""

    of: str
    """Frame."""
    object: str
    """Upright object with a primitive shape."""
    inside: NonNegative = 1.0
    """Factor on the depth within the outline: keeps a pusher from climbing onto the object."""


class Height(Section):
    """Height error of a frame [m]."""

    of: str
    """Frame."""
    target: Finite
    """Wanted height [m]."""
    slack: NonNegative = 0.0
    """Errors up to this cost nothing [m]."""


class Orientation(Section):
    """Angle between the orientations of two frames [rad]."""

    of: str
    """Frame."""
    to: str = "goal"
    """Frame it is compared with."""
    tilt: bool = Field(default=False)
    """Compare the directions of the z axes alone."""


class Approach(Section):
    """Distance of a grasp point to an object [m]."""

    hand: str
    """Frame between the fingertips; its z axis points back to the hand."""
    object: str
    """Object to be gripped at its centre."""
    width: Positive
    """How far beside the object the hand may be to come down on it [m]: about half of what open fingers leave free."""
    rise: NonNegative
    """How far above the object the hand stays farther out [m]: clears the object's top."""


class FingerAlignment(Section):
    """Error of the fingers in meeting a box's faces, 0 to 4/3."""

    hand: str
    """Frame whose y axis is the line along which the fingers close."""
    object: str
    """Box."""


class Gripper(Section):
    """Fingers close at an object and open away from it, 0 to 2."""

    hand: str
    """Frame between the fingertips."""
    object: str
    """Object to be gripped."""
    near: Positive
    """Distance from the hand to the object's centre within which the fingers close [m]."""
    fingers: Annotated[tuple[str, ...], Field(min_length=1)]
    """Controls of the fingers, ``robot/joint``; the upper end of their range opens."""
