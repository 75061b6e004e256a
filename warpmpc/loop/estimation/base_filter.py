# SPDX-License-Identifier: Apache-2.0
"""Contact-aided invariant extended Kalman filter of a floating base (Hartley et al., IJRR 2020)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtri

from .free_joints import cross, cross_matrix, left_jacobian, matrix

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ...scene.schema_estimate import EstimateBase

GRAVITY = (0.0, 0.0, -9.81)
"""Acceleration of free fall on Earth [m/s²]."""
PHI, V, P, FEET = slice(0, 3), slice(3, 6), slice(6, 9), 9
"""Places of the errors of rotation, velocity, position and the first foot."""
SLIPPED = float(chdtri(3, 0.01))
"""Squared Mahalanobis distance of a foot's velocity from zero beyond which it slips."""
MOVED = float(chdtri(3, 1e-4))
"""Squared Mahalanobis distance of a foot from where it stood beyond which it stands somewhere else."""
ASTRAY = 0.03
"""Time for which every foot that carries something may slip; then the base's velocity is doubted [s]."""
LOST = (0.1, 1.0)
"""Standard deviations of rotation [rad] and velocity [m/s] that are added to a base that is doubted."""
UNTRUSTED = (0.05, 0.3)
"""Standard deviations of roll or pitch [rad] and velocity [m/s] from which a base is not trusted."""
SLIP_TIME = 0.03
"""Time within which the velocity of a foot that stands changes [s]: longer ones than physics steps are correlated."""


@dataclass(frozen=True)
class BaseState:
    """Base, feet and biases at a time, with N feet."""

    time: float
    """When [s]."""
    rotation: np.ndarray
    """Axes of the base in the world ``[3, 3]``."""
    velocity: np.ndarray
    """Velocity of the IMU in the world ``[3]`` [m/s]."""
    position: np.ndarray
    """Position of the IMU in the world ``[3]`` [m]."""
    feet: np.ndarray
    """Where each foot stands in the world ``[N, 3]`` [m]."""
    contact: np.ndarray
    """Whether each foot stands ``[N]``."""
    gyro_bias: np.ndarray
    """Bias of the gyroscope ``[3]`` [rad/s]."""
    accel_bias: np.ndarray
    """Bias of the accelerometer ``[3]`` [m/s²]."""
    covariance: np.ndarray
    """Of the errors of rotation, velocity, position, feet, gyroscope's and accelerometer's bias ``[15 + 3N, 15 + 3N]``.

    They are right-invariant: estimate = exp(error) · truth on SE_{2+N}(3); those of biases are differences. Zero for
    feet that do not stand.
    """
    spin: np.ndarray
    """Angular velocity about the base's axes ``[3]`` [rad/s]."""
    foot_spin: np.ndarray
    """Angular velocity of each foot against the base, about the base's axes ``[N, 3]`` [rad/s]."""
    arm: np.ndarray
    """From each foot's frame to where it touches the ground, in the world ``[N, 3]`` [m]: it rolls about that point."""
    astray: float | None = None
    """Time since when all feet that carry something slip [s]; None while one stands, or none carries anything."""

    @property
    def trusted(self) -> bool:
        """Return whether tilt and velocity are known, and feet do not contradict them."""
        doubted = self.astray is not None and self.time - self.astray > ASTRAY
        deviations = np.sqrt(self.covariance.diagonal())
        return not doubted and deviations[:2].max() < UNTRUSTED[0] and deviations[V].max() < UNTRUSTED[1]


@dataclass(frozen=True)
class FeetMeasured:
    """Feet as joints show them, from the IMU and along the base's axes."""

    position: np.ndarray
    """``[N, 3]`` [m]."""
    position_covariance: np.ndarray
    """``[N, 3, 3]`` [m²]."""
    velocity: np.ndarray
    """Against the base ``[N, 3]`` [m/s]."""
    velocity_covariance: np.ndarray
    """``[N, 3, 3]`` [m²/s²]."""
    spin: np.ndarray
    """Angular velocity against the base ``[N, 3]`` [rad/s]."""
    arm: np.ndarray
    """From the foot's frame to where it touches the ground ``[N, 3]`` [m]."""
    loaded: np.ndarray
    """Whether each foot carries something ``[N]``."""
    ground: np.ndarray
    """Height of the scene's ground under each foot in the world ``[N]`` [m], NaN where there is none."""


class BaseFilter:
    """Right-invariant filter of a base from an IMU and feet that stand.

    Rotation, velocity, position and feet are one element of SE_{2+N}(3), so that the linear model of its error does not
    depend on what is estimated but for the biases: yaw and horizontal position, which nothing measures, stay
    unobservable in the filter, too (Hartley et al., Section 6). Beyond the paper feet roll about the point in which
    they touch, those that slip by their velocity are left out, and the scene's ground tells their height.

    Args:
        estimate: What the scene says of it.
        feet: Number of feet N.
        gravity: Acceleration of free fall [m/s²].
    """

    def __init__(self, estimate: EstimateBase, feet: int, gravity: Sequence[float] = GRAVITY):
        self._gravity = np.array(gravity)
        self._estimate, self.feet = estimate, feet
        end = FEET + 3 * feet
        self.gyro_bias, self.accel_bias = slice(end, end + 3), slice(end + 3, end + 6)
        """Places of the errors of biases."""
        self.size = end + 6
        """Number of errors."""
        self._slip = estimate.slip * math.sqrt(2.0 * SLIP_TIME) * np.eye(3)
        self._identity = np.eye(self.size)

    def foot(self, i: int) -> slice:
        """Places of a foot's errors."""
        return slice(FEET + 3 * i, FEET + 3 * i + 3)

    def start(self, time: float, rotation: np.ndarray, position: np.ndarray) -> BaseState:
        """The estimate of a base that begins at rest, at a position ``[3]`` [m] and rotation ``[3, 3]`` of the IMU."""
        imu, begin, none = self._estimate.imu, self._estimate.start, np.zeros((self.feet, 3))
        deviation = np.zeros(self.size)
        deviation[PHI], deviation[V] = [begin.tilt, begin.tilt, 0.0], begin.velocity
        deviation[self.gyro_bias], deviation[self.accel_bias] = imu.gyro_bias, imu.accel_bias
        about = np.eye(self.size)
        about[P, PHI] = cross_matrix(position)  # the base tilts about itself, not about the world's origin
        return BaseState(
            time=time,
            rotation=np.asarray(rotation, dtype=float),
            velocity=np.zeros(3),
            position=np.asarray(position, dtype=float),
            feet=none,
            contact=np.zeros(self.feet, dtype=bool),
            gyro_bias=np.zeros(3),
            accel_bias=np.zeros(3),
            covariance=(about * deviation**2) @ about.T,
            spin=np.zeros(3),
            foot_spin=none,
            arm=none,
        )

    def propagate(self, state: BaseState, time: float, gyro: np.ndarray, accel: np.ndarray) -> BaseState:
        """The estimate at a later time [s].

        Args:
            state: The estimate.
            time: When.
            gyro: Mean angular velocity until then ``[3]`` [rad/s].
            accel: Mean proper acceleration until then ``[3]`` [m/s²].
        """
        dt = time - state.time
        if dt <= 0.0:
            return state
        spin, force = gyro - state.gyro_bias, accel - state.accel_bias
        transition = self.transition(state, spin, dt)
        carried = transition @ self._spread(state)
        covariance = transition @ state.covariance @ transition.T + dt * carried @ carried.T
        turn, rotation = dt * spin, state.rotation
        # integrals of a rotation that turns evenly, to second order (Hartley et al., Eq. 66)
        bent = cross(turn, force)
        pushed = rotation @ (force + 0.5 * bent) + self._gravity
        moved = rotation @ (force + bent / 3.0) + self._gravity
        return replace(
            state,
            time=time,
            rotation=rotation @ matrix(turn),
            velocity=state.velocity + dt * pushed,
            position=state.position + dt * state.velocity + 0.5 * dt * dt * moved,
            feet=state.feet + dt * self._rolling(state, spin),
            covariance=covariance,
            spin=spin,
        )

    def _rolling(self, state: BaseState, spin: np.ndarray) -> np.ndarray:
        """Velocities of the frames of feet that stand ``[N, 3]`` [m/s]; zero for others."""
        turning = (state.foot_spin + spin) @ state.rotation.T
        return cross(state.arm, turning) * state.contact[:, None]

    def transition(self, state: BaseState, spin: np.ndarray, dt: float) -> np.ndarray:
        """Errors after a time [s] from those before it ``[size, size]``.

        The error's dynamics are those of Hartley et al., Eq. 52, with rolling feet; the exponential's series ends, for
        the fourth power is zero.
        """
        rotation, a = dt * state.rotation, np.zeros((self.size, self.size))
        a[PHI, self.gyro_bias] = a[V, self.accel_bias] = -rotation
        a[V, PHI] = dt * cross_matrix(self._gravity)
        a[V, self.gyro_bias] = -cross_matrix(state.velocity) @ rotation
        a[P, V] = dt * _EYE
        a[P, self.gyro_bias] = -cross_matrix(state.position) @ rotation
        for i in np.flatnonzero(state.contact):
            arm, turning, at = state.arm[i], rotation @ (state.foot_spin[i] + spin), self.foot(i)
            # the ground does not tilt with the estimate
            a[at, PHI] = -arm[2] * cross_matrix(turning) @ _UP_MATRIX
            a[at, self.gyro_bias] = -cross_matrix(state.feet[i] + arm) @ rotation
        twice = a @ a
        return self._identity + a + 0.5 * twice + twice @ a / 6.0

    def _spread(self, state: BaseState) -> np.ndarray:
        """Densities of the noise in the errors: the adjoint of the estimate times those of sensors and feet."""
        imu, rotation, n = self._estimate.imu, state.rotation, 3 * self.feet
        spread = np.zeros((self.size, 12 + n))
        turned = imu.gyro * rotation
        spread[PHI, 0:3] = turned
        spread[V, 0:3] = cross_matrix(state.velocity) @ turned
        spread[P, 0:3] = cross_matrix(state.position) @ turned
        spread[V, 3:6] = imu.accel * rotation
        spread[self.gyro_bias, 6:9] = imu.gyro_walk * _EYE
        spread[self.accel_bias, 9:12] = imu.accel_walk * _EYE
        for i in np.flatnonzero(state.contact):
            spread[self.foot(i), 0:3] = cross_matrix(state.feet[i] + state.arm[i]) @ turned
            spread[self.foot(i), 12 + 3 * i : 15 + 3 * i] = self._slip
        return spread

    def correct(self, state: BaseState, measured: FeetMeasured) -> BaseState:
        """The estimate with feet that were measured at its time.

        Feet that stood and stand correct it. Those that come down, or stand somewhere else as their distance tells,
        stand there from now on; those that slip do not stand. Where all that carry something slip for :data:`ASTRAY`,
        the base is what is wrong: it is taken to be as uncertain as :data:`LOST`, so that feet correct it.
        """
        standing = measured.loaded & self.stands(state, measured)
        astray = measured.loaded.any() and not standing.any()
        since = (state.time if state.astray is None else state.astray) if astray else None
        if since is not None and state.time - since > ASTRAY:
            state = self.doubted(state, tilted(LOST[0]), LOST[1])
            standing = measured.loaded & self.stands(state, measured)
        state = replace(state, astray=since)
        state, kept = self._corrected(state, measured, np.flatnonzero(state.contact & standing).tolist())
        rotation, covariance, feet = state.rotation, state.covariance.copy(), state.feet.copy()
        for i in range(self.feet):
            if i in kept:
                continue
            at = self.foot(i)
            covariance[at] = covariance[:, at] = 0.0
            feet[i] = state.position + rotation @ measured.position[i]
            if standing[i]:  # its error is the IMU's and that of the joints (Hartley et al., Section 5.2)
                covariance[at], covariance[:, at] = covariance[P], covariance[:, P]
                covariance[at, at] = covariance[P, P] + rotation @ measured.position_covariance[i] @ rotation.T
        return replace(
            state,
            feet=feet,
            contact=standing,
            covariance=covariance,
            foot_spin=measured.spin,
            arm=measured.arm @ rotation.T,
        )

    def doubted(self, state: BaseState, turn: np.ndarray, velocity: float) -> BaseState:
        """The estimate with a covariance of its rotation ``[3, 3]`` [rad²] and a deviation of velocity [m/s] added."""
        more = np.zeros((self.size, self.size))
        more[PHI, PHI], more[V, V] = turn, velocity**2 * _EYE
        about = np.eye(self.size)
        about[P, PHI] = cross_matrix(state.position)
        return replace(state, covariance=state.covariance + about @ more @ about.T)

    def with_legs(
        self, state: BaseState, measured: FeetMeasured, covariance: np.ndarray
    ) -> tuple[BaseState, np.ndarray]:
        """The estimate that moves and turns so that feet that carry something are at rest, for when no unit tells.

        Args:
            state: The estimate.
            measured: Feet as joints show them.
            covariance: Of its angular velocity about its axes ``[3, 3]`` [rad²/s²].

        Returns:
            The estimate, and the covariance of its angular velocity now.
        """
        rotation, loaded = state.rotation, np.flatnonzero(measured.loaded)
        slipping, spread = self._slipping(state, measured)
        arms = [cross_matrix(arm) for arm in measured.position + measured.arm]
        matrix, right = np.linalg.inv(covariance), np.zeros(3)
        for i in loaded:
            weighed = np.linalg.solve(rotation.T @ spread[i] @ rotation, np.c_[arms[i], slipping[i]])
            matrix, right = matrix + arms[i].T @ weighed[:, :3], right + arms[i].T @ weighed[:, 3]
        covariance = np.linalg.inv(matrix)
        state = replace(state, spin=state.spin + covariance @ right)
        feet = loaded[self.stands(state, measured)[loaded]]
        if not len(feet):
            return state, covariance
        slipping, spread = self._slipping(state, measured)
        design, noise = np.zeros((3 * len(feet), self.size)), np.zeros((3 * len(feet), 3 * len(feet)))
        for k, i in enumerate(feet):  # that they are at rest is right-invariant: it shows the velocity's own error
            row, turned = slice(3 * k, 3 * k + 3), rotation @ arms[i]
            design[row, V] = _EYE
            noise[row, row] = spread[i] - state.covariance[V, V] + turned @ covariance @ turned.T
        return self._updated(state, (slipping[feet] @ rotation.T).ravel(), design, noise), covariance

    def stands(self, state: BaseState, measured: FeetMeasured) -> np.ndarray:
        """Return whether the point in which each foot touches is at rest, as far as its velocity is known ``[N]``."""
        slipping, spread = self._slipping(state, measured)
        velocity = slipping @ state.rotation.T
        found = np.linalg.solve(spread, velocity[:, :, None])[:, :, 0]
        return (found * velocity).sum(axis=1) <= SLIPPED

    def _slipping(self, state: BaseState, measured: FeetMeasured) -> tuple[np.ndarray, np.ndarray]:
        """Velocities of feet where they touch, along the base's axes ``[N, 3]``, and their covariance in the world."""
        rotation = state.rotation
        spin, point = state.spin + measured.spin, measured.position
        local = measured.velocity + cross(state.spin, point) + cross(spin, measured.arm)
        spread = state.covariance[V, V] + rotation @ measured.velocity_covariance @ rotation.T
        return state.velocity @ rotation + local, spread + self._estimate.slip**2 * _EYE

    def innovation(
        self, state: BaseState, measured: FeetMeasured, feet: list[int]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Innovation by feet that stand: what they show of the errors, its matrix and its noise.

        A foot's position against the IMU is right-invariant (Hartley et al., Eq. 30); the height of the ground under it
        is a position in the world.

        Returns:
            Innovation ``[m]`` [m], matrix ``[m, size]`` and covariance ``[m, m]``; three rows for each foot, then one
            for each with ground under it.
        """
        rotation, n = state.rotation, 3 * len(feet)
        ground = [i for i in feet if math.isfinite(measured.ground[i])]
        off, design = np.zeros(n + len(ground)), np.zeros((n + len(ground), self.size))
        noise = np.zeros((len(off), len(off)))
        for k, i in enumerate(feet):
            row = slice(3 * k, 3 * k + 3)
            off[row] = rotation @ measured.position[i] - (state.feet[i] - state.position)
            design[row, P], design[row, self.foot(i)] = _EYE, -_EYE
            noise[row, row] = rotation @ measured.position_covariance[i] @ rotation.T
        for row, i in enumerate(ground, n):
            x, y, z = state.feet[i]
            off[row] = measured.ground[i] - (z + rotation[2] @ measured.arm[i])
            design[row, 0:2], design[row, FEET + 3 * i + 2] = (-y, x), -1.0
            noise[row, row] = self._estimate.ground**2
        return off, design, noise

    def _corrected(self, state: BaseState, measured: FeetMeasured, feet: list[int]) -> tuple[BaseState, list[int]]:
        """The estimate with those feet that are where they stood, and which they are."""
        if not feet:
            return state, feet
        off, design, noise = self.innovation(state, measured, feet)
        spread = design @ state.covariance @ design.T + noise
        kept = []
        for k, i in enumerate(feet):
            row = slice(3 * k, 3 * k + 3)
            if off[row] @ np.linalg.solve(spread[row, row], off[row]) <= MOVED:
                kept.append(i)
        if len(kept) < len(feet):
            return self._corrected(state, measured, kept)
        return self._updated(state, off, design, noise), kept

    def _updated(self, state: BaseState, off: np.ndarray, design: np.ndarray, noise: np.ndarray) -> BaseState:
        """The estimate with an innovation ``[m]``, its matrix ``[m, size]`` and covariance ``[m, m]``."""
        shared = state.covariance @ design.T
        gain = np.linalg.solve(design @ shared + noise, shared.T).T
        keep = self._identity - gain @ design
        covariance = keep @ state.covariance @ keep.T + gain @ noise @ gain.T  # Joseph's form
        return replace(self.moved(state, -gain @ off), covariance=0.5 * (covariance + covariance.T))

    def moved(self, state: BaseState, error: np.ndarray) -> BaseState:
        """The estimate moved by an error ``[size]``: exp(error) · estimate, and the sum for biases."""
        turn = matrix(error[PHI])
        shifts = error[3 : FEET + 3 * self.feet].reshape(-1, 3) @ left_jacobian(error[PHI]).T
        rows = np.vstack([state.velocity, state.position, state.feet]) @ turn.T + shifts
        return replace(
            state,
            rotation=turn @ state.rotation,
            velocity=rows[0],
            position=rows[1],
            feet=rows[2:],
            gyro_bias=state.gyro_bias + error[self.gyro_bias],
            accel_bias=state.accel_bias + error[self.accel_bias],
        )


def tilted(deviation: float) -> np.ndarray:
    """Covariance ``[3, 3]`` of roll and pitch with a deviation [rad]."""
    return np.diag([deviation**2, deviation**2, 0.0])


_EYE = np.eye(3)
_UP_MATRIX = cross_matrix(np.array([0.0, 0.0, 1.0]))
