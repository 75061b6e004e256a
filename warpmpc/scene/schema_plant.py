# SPDX-License-Identifier: Apache-2.0
"""The types of the simulated plant: what befalls it and how it is observed."""

from __future__ import annotations

from pydantic import Field

from .schema_estimate import Sensors
from .types import Count, Flag, Floats, NonNegative, Positive, Section


class Kick(Section):
    """A shove: a sudden change of velocity of an object or of a robot's joints."""

    time: NonNegative
    """When [s]."""
    target: str
    """Object or robot."""
    velocity: Floats
    """Object, or robot with a free root: change of linear velocity (x, y, z) [m/s]. Robot: change of each joint's
    velocity [m/s or rad/s], of a free root the linear one."""


class PlantNoise(Section):
    """Gaussian observation noise, as standard deviations."""

    position: NonNegative = 0.0
    """Joint positions and object positions [m or rad]."""
    velocity: NonNegative = 0.0
    """Velocities [m/s or rad/s]."""


class PlantFactors(Section):
    """Factors by which a thing in the plant differs from what the planner takes it to be."""

    mass: Positive = 1.0
    """Factor on every mass."""
    friction: NonNegative = 1.0
    """Factor on every coefficient of friction."""
    size: Positive = 1.0
    """Factor on the dimensions of an object or obstacle; its mass stays."""


class PlantSettings(Section):
    """Differences of the simulated plant from the planner's worlds."""

    substeps: Count | None = None
    """Physics steps per control: finer than the planner's. When left out, as many as the timestep of an MJCF file asks
    for, else 8."""
    randomize: Flag = True
    """Whether the plant has randomized properties of its own, drawn like the rollouts'."""
    factor: dict[str, PlantFactors] = Field(default_factory=dict)
    """Robot, object or obstacle → factors on its properties in the plant alone, besides what is drawn: what the
    planner has wrong."""
    noise: PlantNoise = PlantNoise()
    """Noise of what is observed."""
    delay: NonNegative = 0.0
    """Age of observations [s], rounded to whole controls; episodes of a scene that estimates something predict them to
    the present."""
    sensor: Sensors = Sensors()
    """Sensors that measure at rates of their own."""
    kicks: tuple[Kick, ...] = ()
    """Shoves during the run."""
