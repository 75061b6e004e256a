# SPDX-License-Identifier: Apache-2.0
"""The types of measurements that a simulated plant makes, and of states that are estimated from measurements.

The types of inertial measurement units, of joints' encoders, and of a floating base that is estimated from them.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from pydantic import Field

from .types import Fraction, NonNegative, Positive, Section


class ImuNoise(Section):
    """Errors of an inertial measurement unit, by default those of a Bosch BMI088 (data sheet BST-BMI088-DS001)."""

    gyro: Positive = 2.4e-4
    """Density of the gyroscope's white noise [rad/s/√Hz]."""
    accel: Positive = 1.7e-3
    """Density of the accelerometer's white noise [m/s²/√Hz]."""
    gyro_walk: NonNegative = 4.8e-5
    """Random walk of the gyroscope's bias [rad/s/√s]: what its temperature does that wanders by 1 K in 30 s."""
    accel_walk: NonNegative = 3.6e-4
    """Random walk of the accelerometer's bias [m/s²/√s], likewise."""
    gyro_bias: NonNegative = 2.6e-3
    """Standard deviation of the gyroscope's bias at the start [rad/s]: zeroed at rest, and 10 K warmer since."""
    accel_bias: NonNegative = 0.2
    """Standard deviation of the accelerometer's bias at the start [m/s²]: never calibrated."""
    gyro_range: Positive = 34.9
    """Largest angular velocity that the gyroscope shows [rad/s]; a measurement that reaches it is left out."""
    accel_range: Positive = 235.0
    """Largest acceleration that the accelerometer shows [m/s²]; a measurement that reaches it is left out."""


class JointNoise(Section):
    """Standard deviations of what joints show."""

    position: NonNegative = 0.001
    """Coordinate [rad or m]."""
    velocity: NonNegative = 0.05
    """Velocity [rad/s or m/s]."""
    effort: NonNegative = 0.5
    """Torque or force of the drive, as motors know it by their currents [N·m or N]."""


class ImuSensor(Section):
    """Inertial measurement unit of a robot with a free root, which shows means over the time since it did so last."""

    frame: str | None = None
    """Frame ``robot/frame`` of the unit, fixed to the root; the root itself when left out."""
    rate: Positive = 400.0
    """Measurements a second [1/s], at most one for every physics step."""
    noise: ImuNoise = ImuNoise()
    """Noise and biases."""
    delay: NonNegative = 0.0
    """Time from a measurement to when it is known [s]."""
    dropouts: Fraction = 0.0
    """Share of the measurements that are lost."""


class JointSensor(Section):
    """Encoders and drives of the joints of a robot."""

    rate: Positive = 400.0
    """Measurements a second [1/s], at most one for every physics step."""
    noise: JointNoise = JointNoise()
    """Noise of every joint."""
    delay: NonNegative = 0.0
    """Time from a measurement to when it is known [s]."""
    dropouts: Fraction = 0.0
    """Share of the measurements that are lost."""


class StartNoise(Section):
    """Standard deviations of what the scene says of the start; yaw and position are what the world is measured from."""

    tilt: Positive = 0.02
    """Roll and pitch [rad]."""
    velocity: Positive = 0.05
    """Velocity along every axis [m/s]."""


class EstimateBase(Section):
    """Estimation of a free root, and of joints, from an inertial measurement unit, joints and standing feet."""

    feet: Annotated[tuple[str, ...], Field(min_length=1)]
    """Frames of the feet, ``robot/frame``."""
    frame: str | None = None
    """Frame ``robot/frame`` of the inertial measurement unit, fixed to the root; the root itself when left out."""
    imu: ImuNoise = ImuNoise()
    """Assumed errors of the unit."""
    joints: JointNoise = JointNoise()
    """Assumed noise of the joints."""
    start: StartNoise = StartNoise()
    """Uncertainty of the start."""
    kinematics: Positive = 0.002
    """Standard deviation of a foot's position by leg kinematics [m]."""
    load: Positive = 40.0
    """Least upward force on a standing foot [N], from the efforts of its leg's joints."""
    slip: Positive = 0.05
    """Standard deviation of the velocity of standing feet [m/s]; much faster ones count as slipping."""
    ground: Positive = 0.01
    """Standard deviation of the height of standing feet about the ground [m]."""


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
    """Model of the motion between measurements."""
    process: ProcessNoise = ProcessNoise()
    """Noise of the motion."""
    noise: MeasurementNoise = MeasurementNoise()
    """Assumed errors of measurements."""
    gate: Fraction | None = 0.999
    """Share of good measurements that pass the gate; those farther off are left out. ``false``: no gate."""
