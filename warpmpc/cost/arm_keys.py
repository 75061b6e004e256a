# SPDX-License-Identifier: Apache-2.0
"""The keys of an arm's cost terms in scene files."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from pydantic import Field

from ..scene.types import (
    Floats,
    Fraction,
    NonNegative,
    NonNegatives,
    Positive,
    Positives,
    Section,
)
from .keys import Joints


class Form(StrEnum):
    """Cost of manipulability below its least value."""

    RAMP = "ramp"
    STEP = "step"


class Pose(Section):
    """Error of a frame's pose."""

    of: str
    """Frame."""
    to: str = "goal"
    """Frame it is compared with."""
    position: NonNegatives = (1.0,)
    """Weight of the distance [1/m], one or one for each axis of the second frame; 0 holds the orientation alone."""
    rotation: NonNegatives = (1.0,)
    """Weight of the orientation, one or one for each axis of the second frame: of how far that axis is off."""


class Stop(Joints):
    """Speed from which joints do not stop within the horizon."""

    acceleration: Positives | None = None
    """Greatest acceleration [m/s² or rad/s²], one or one per joint; the drives' where they take accelerations."""


class FrameChain(Section):
    """The joints that move a frame."""

    of: str
    """Frame of a robot."""
    joints: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    """Joints that count of those that move the frame, ``robot/joint`` or the joint's own name; all when left out."""


class Manipulability(FrameChain):
    """Nearness of a frame to a posture from which it cannot move every way."""

    least: Positive = 0.03
    """Manipulability k_m from which on nothing is to pay; a Panda's is up to about 0.1."""
    form: Form = Form.RAMP
    """ramp: (k_m - m)/k_m, from 0 to 1; step: 1 - m."""


class JointBounds(Joints):
    """Squared distance outside joint limits of all kinds."""

    margin: Fraction = 0.05
    """Share that every range is shrunk by, about its middle."""
    velocity: Positives | None = None
    """Greatest speed [m/s or rad/s], one or one per joint; the asset's when left out."""
    acceleration: Positives | None = None
    """Greatest acceleration [m/s² or rad/s²], one or one per joint; none when left out."""
    jerk: Positives | None = None
    """Greatest jerk [m/s³ or rad/s³], one or one per joint; none when left out."""


class NullPosture(FrameChain):
    """Distance to a posture, as far as the frame's pose leaves it free."""

    target: Floats | None = None
    """Wanted posture [m or rad], by joint from the root on or as in ``joints``; the scene's start when left out."""
    damping: Positive = 0.01
    """Singular value of the Jacobian at which a direction belongs half to the null space."""


class PathDeviation(Section):
    """Distance of a frame from a straight line."""

    of: str
    """Frame."""
    to: str = "goal"
    """Frame at the end of the line."""
    start: str | None = None
    """Frame at its beginning; where the first frame was when the rollout began if left out."""


class Speed(Section):
    """Speed of a frame above a limit."""

    of: str
    """Frame."""
    linear: NonNegative | None = None
    """Speed of its origin that costs nothing [m/s]; any when left out."""
    angular: NonNegative | None = None
    """Speed of turning that costs nothing [rad/s]; any when left out."""


class Smoothness(Joints):
    """Squared accelerations and jerks of joints."""

    acceleration: NonNegative = 1.0
    """Factor on q̈² [(rad/s²)⁻² or (m/s²)⁻²]."""
    jerk: NonNegative = 0.0
    """Factor on q⃛² [(rad/s³)⁻² or (m/s³)⁻²]."""
