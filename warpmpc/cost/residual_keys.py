# SPDX-License-Identifier: Apache-2.0
"""The keys of residual terms in scene files."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from ..scene.types import Finite, Names, NonNegative, OneOrSeveral, Section
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


class ResidualKeys(Section):
    """A residual and its norm."""

    target: Wanted | None = None
    """What the residual's numbers shall be: numbers or names of scalars, one or one for each; 0 when left out."""
    norm: NormKey = NormKind.QUADRATIC
    """quadratic, or { kind, p, q }: l2, l22, cosh, power, smooth_abs, smooth_abs2, rectify."""


class SpatialResidual(ResidualKeys):
    """A residual along axes of the world, or ahead, to the left and up."""

    of: Place
    """Frame, or { centre_of_mass = "robot" }, or a list of such: their mean."""
    axes: Axes | None = None
    """Axes that count, such as "xy"; all when left out, but for heights of goals that have none."""
    heading: str | None = None
    """Frame whose heading, its x axis seen from above, the axes turn with; they are the world's when left out."""


class Position(SpatialResidual):
    """Position of a place [m]."""

    relative_to: Place | None = None
    """Place it is seen from, as ``of``; the world's origin when left out."""
    lead: NonNegative = 0.0
    """Look at where ``of`` would coast to in this time [s]."""


class Velocity(SpatialResidual):
    """Velocity of a place [m/s]."""

    relative_to: Place | None = None
    """Place whose velocity is taken off, as ``of``."""


class AngularVelocity(ResidualKeys):
    """Angular velocity of a frame [rad/s]."""

    of: Names
    """Frame, or a list of frames: their mean."""
    relative_to: Names | None = None
    """Frame whose angular velocity is taken off, as ``of``."""
    axes: Axes = "xyz"
    """Axes of the world that count."""


class Momentum(ResidualKeys):
    """Momentum of all that belongs to something."""

    of: str
    """Robot, object, or ``robot/link`` with all that hangs on it."""
    axes: Axes = "xyz"
    """Axes of the world that count."""


class RotationKeys(Section):
    """Rotation between two frames."""

    of: str
    """Frame."""
    to: str = "goal"
    """Frame it is compared with."""
    axes: Axes = "xyz"
    """Axes of the frames that are compared: "z" leaves turns about it free."""
    norm: NormKey = NormKind.QUADRATIC
    """quadratic, or { kind, p, q }: l2, l22, cosh, power, smooth_abs, smooth_abs2, rectify."""


class JointNumbers(ResidualKeys):
    """Numbers of joints."""

    of: str | None = None
    """Robot; the first when left out."""
    joints: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    """Joints, ``robot/joint`` or the joint's own name, in place of ``of``."""


class PostureNumbers(JointNumbers):
    """Positions of joints."""

    target: Wanted | None = None
    """Positions [m or rad]: numbers or names of scalars, one or one for each joint; the start when left out."""


class Controls(ResidualKeys):
    """Controls."""

    of: str | None = None
    """Robot; all when left out."""
    controls: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    """Controls, ``robot/joint`` or ``robot/actuator``, in place of ``of``."""


class Sensors(ResidualKeys):
    """Sensors of MJCF files."""

    sensors: Names
    """Sensors, ``robot/sensor`` or the sensor's own name, with all their numbers."""


class Contact(ResidualKeys):
    """Contact of pairs of entities."""

    between: tuple[str, str]
    """Two entities or groups (obstacles, objects, robots)."""
    least: NonNegative = 0.0
    """They touch where they push harder than this [N]."""


class ContactForceNumbers(ResidualKeys):
    """Net contact forces on the first of each pair [N]."""

    between: tuple[str, str]
    """Two entities or groups (obstacles, objects, robots)."""
    axes: Axes = "xyz"
    """Axes of the world that count."""
