# SPDX-License-Identifier: Apache-2.0
"""The types of measurements that a simulated plant makes, and of states that are estimated from measurements."""

from __future__ import annotations

from enum import StrEnum

from pydantic import Field

from .schema_base import ImuSensor, JointSensor
from .types import Fraction, NonNegative, Positive, Section


class PoseError(Section):
    """Errors of a measured pose."""

    position: NonNegative = 0.0
    """Standard deviation along every axis [m]."""
    rotation: NonNegative = 0.0
    """Standard deviation about every axis [rad]."""


class PoseSensor(Section):
    """Measurement of the pose of an object, or of a robot with a free root."""

    rate: Positive = 30.0
    """Measurements a second, at most one in a physics step of the plant [1/s]."""
    noise: PoseError = PoseError()
    """Errors of every measurement."""
    bias: PoseError = PoseError()
    """Errors that stay for a run."""
    delay: NonNegative = 0.0
    """Time from a measurement to when it is known [s]."""
    dropouts: Fraction = 0.0
    """Share of the measurements that are lost."""


class Sensors(Section):
    """Sensors of the simulated plant."""

    pose: dict[str, PoseSensor] = Field(default_factory=dict)
    """Object, or robot with a free root → how its pose is measured, in place of being observed as it is."""
    imu: dict[str, ImuSensor] = Field(default_factory=dict)
    """Robot with a free root → its inertial measurement unit, for ``estimate_base``."""
    joints: dict[str, JointSensor] = Field(default_factory=dict)
    """Robot → what its joints show, for ``estimate_base``."""


class PoseModel(StrEnum):
    """Motions that filters of poses take for the likeliest."""

    CONSTANT_VELOCITY = "constant_velocity"
    """At a constant velocity, which noise changes."""
    CONSTANT_ACCELERATION = "constant_acceleration"
    """At a constant acceleration, which noise changes."""


class ProcessNoise(Section):
    """Standard deviations of what noise changes within a second, growing with the square root of time."""

    linear: Positive = 1.0
    """Velocity [m/s]; acceleration [m/s²] with ``constant_acceleration``."""
    angular: Positive = 5.0
    """Angular velocity [rad/s]; angular acceleration [rad/s²] with ``constant_acceleration``."""


class MeasurementNoise(Section):
    """Noise of measured poses."""

    position: Positive = 0.01
    """Standard deviation along every axis [m]."""
    rotation: Positive = 0.05
    """Standard deviation about every axis [rad]."""


class Estimate(Section):
    """Estimation of a pose and its velocity from measured poses."""

    model: PoseModel = PoseModel.CONSTANT_VELOCITY
    """Motion between measurements."""
    process: ProcessNoise = ProcessNoise()
    """Changes of the motion."""
    noise: MeasurementNoise = MeasurementNoise()
    """Errors that measurements are taken to have."""
    gate: Fraction | None = 0.999
    """Share of good measurements that are believed: those farther off are left out, ``false`` for none."""
