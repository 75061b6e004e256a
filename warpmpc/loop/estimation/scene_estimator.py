# SPDX-License-Identifier: Apache-2.0
"""Estimated state of a scene: what its estimators know in place of what is observed.

Kalman filters of a pose that moves at a nearly constant velocity or acceleration, on its tangent space.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtri

from ...scene.model.state import State
from ...scene.schema_estimate import PoseModel
from .base_estimator import BaseEstimator
from .free_joints import FreeJoint, exp, inverse, left_jacobian, log, matrix, multiply
from .measurement import FARTHEST, History, PoseMeasured, plausible

if TYPE_CHECKING:
    from ...scene.model.compiled import CompiledScene
    from ...scene.schema import Scene
    from ...scene.schema_estimate import Estimate
    from .measurement import Estimator, Measurement

REJECTED = 5
"""Measurements in a row that a gate leaves out, after which the filter begins anew with the next."""
LONGEST = 0.25
"""Longest time that a motion goes on without a measurement [s]; then the pose stays where it came to."""


@dataclass(frozen=True)
class PoseEstimate:
    """Pose, derivatives and their covariance at a time; of order n with n derivatives."""

    time: float
    """Time of the estimate [s]."""
    position: np.ndarray
    """Position ``[3]`` [m]."""
    rotation: np.ndarray
    """Quaternion (x, y, z, w) ``[4]``."""
    linear: np.ndarray
    """Velocity, and acceleration of order 2, of the body's origin ``[n, 3]`` [m/s, m/s²]."""
    angular: np.ndarray
    """Angular velocity, and acceleration of order 2, in the world ``[n, 3]`` [rad/s, rad/s²]."""
    covariance: np.ndarray
    """Of the errors: position, linear derivatives, rotation, angular derivatives ``[6 (n + 1), 6 (n + 1)]``.

    The rotation's error is the vector δ in the world with true rotation = exp(δ) · estimate.
    """
    measured: float
    """Time of the last measurement that was believed [s]."""
    rejected: int = 0
    """Measurements in a row that were not."""


class PoseFilter:
    """Error-state Kalman filter of a pose (Solà 2017; white noise in the highest derivative: Bar-Shalom et al. 2001).

    States are values: ``start``, ``predict`` and ``correct`` make new ones, so that a :class:`History` may keep them.

    Args:
        estimate: What the scene says of it.
    """

    def __init__(self, estimate: Estimate):
        self.order = 2 if estimate.model is PoseModel.CONSTANT_ACCELERATION else 1
        process, noise = estimate.process, estimate.noise
        self._density = np.array([process.linear, process.angular]) ** 2
        self._noise = np.repeat(np.array([noise.position, noise.rotation]) ** 2, 3)
        self.bound = math.inf if estimate.gate is None else float(chdtri(6, 1.0 - estimate.gate))
        """Largest squared Mahalanobis distance of a measurement that is believed."""
        self._size = 3 * (self.order + 1)
        self._seen = np.r_[0:3, self._size : self._size + 3]  # errors that a pose shows

    def start(self, measurement: PoseMeasured) -> PoseEstimate:
        """The estimate after the first measurement: at rest, as uncertain as motion changes in a second."""
        n, zero = self.order, np.zeros((self.order, 3))
        variance = [np.r_[self._noise[3 * i : 3 * i + 3], np.full(3 * n, self._density[i])] for i in range(2)]
        pose = np.asarray(measurement.pose, dtype=float)
        covariance = np.diag(np.concatenate(variance))
        return PoseEstimate(measurement.time, pose[:3], _unit(pose[3:]), zero, zero, covariance, measurement.time)

    def predict(self, estimate: PoseEstimate, time: float) -> PoseEstimate:
        """The estimate at a later time [s]."""
        dt, n, size = time - estimate.time, self.order, self._size
        if dt <= 0.0:
            return estimate
        powers = self._powers(dt)
        turn = powers[1] * estimate.angular[0] + (powers[2] * estimate.angular[1] if n > 1 else 0.0)
        chains = [np.vstack([estimate.position, estimate.linear]), np.vstack([np.zeros(3), estimate.angular])]
        step = self._taylor(powers)
        moved = [step @ chain for chain in chains]
        jacobian = np.zeros((2 * size, 2 * size))
        jacobian[:size, :size] = jacobian[size:, size:] = _of_axes(step)
        left = left_jacobian(turn)
        for k in range(n + 1):
            at = size + 3 * k
            jacobian[size : size + 3, at : at + 3] = matrix(turn) if k == 0 else powers[k] * left
        covariance = jacobian @ estimate.covariance @ jacobian.T
        grown = _of_axes(self._growth(dt))
        for i, density in enumerate(self._density):
            covariance[i * size : (i + 1) * size, i * size : (i + 1) * size] += density * grown
        return replace(
            estimate,
            time=time,
            position=moved[0][0],
            rotation=_unit(multiply(exp(turn), estimate.rotation)),
            linear=moved[0][1:],
            angular=moved[1][1:],
            covariance=covariance,
        )

    def correct(self, estimate: PoseEstimate, measurement: PoseMeasured) -> PoseEstimate:
        """The estimate with a measurement of its time, if the gate lets it through."""
        pose, seen = np.asarray(measurement.pose, dtype=float), self._seen
        off = np.r_[pose[:3] - estimate.position, log(multiply(_unit(pose[3:]), inverse(estimate.rotation)))]
        cross = estimate.covariance[:, seen]
        spread = cross[seen] + np.diag(self._noise)
        gain = np.linalg.solve(spread, cross.T).T
        if float(off @ np.linalg.solve(spread, off)) > self.bound:
            rejected = estimate.rejected + 1
            return self.start(measurement) if rejected > REJECTED else replace(estimate, rejected=rejected)
        error = gain @ off
        keep = np.eye(len(error))
        keep[:, seen] -= gain
        covariance = keep @ estimate.covariance @ keep.T + (gain * self._noise) @ gain.T  # Joseph's form
        size, turn = self._size, error[self._size : self._size + 3]
        left = left_jacobian(turn)  # errors are counted from the new rotation on
        covariance[size : size + 3] = left @ covariance[size : size + 3]
        covariance[:, size : size + 3] = covariance[:, size : size + 3] @ left.T
        chains = error.reshape(2, -1, 3)
        return replace(
            estimate,
            position=estimate.position + chains[0, 0],
            rotation=_unit(multiply(exp(turn), estimate.rotation)),
            linear=estimate.linear + chains[0, 1:],
            angular=estimate.angular + chains[1, 1:],
            covariance=0.5 * (covariance + covariance.T),
            measured=measurement.time,
            rejected=0,
        )

    def reach(self, estimate: PoseEstimate, time: float) -> PoseEstimate:
        """The estimate at a time [s] at which nothing was measured: at rest where :data:`LONGEST` is over."""
        end = estimate.measured + LONGEST
        if time <= end:
            return self.predict(estimate, time)
        moved = self.predict(estimate, end)
        return replace(moved, time=time, linear=0.0 * moved.linear, angular=0.0 * moved.angular)

    def _powers(self, dt: float) -> list[float]:
        return [dt**k / math.factorial(k) for k in range(self.order + 1)]

    def _taylor(self, powers: list[float]) -> np.ndarray:
        """Derivatives after a step from those before it ``[n + 1, n + 1]``."""
        return sum(np.diag(np.full(self.order + 1 - k, power), k) for k, power in enumerate(powers))

    def _growth(self, dt: float) -> np.ndarray:
        """Covariance that white noise of density 1 in the highest derivative adds in a step ``[n + 1, n + 1]``."""
        left = np.array([dt**k for k in self._orders]) / self._factorials
        return np.outer(left, left) * dt / (self._orders[:, None] + self._orders + 1)

    @cached_property
    def _orders(self) -> np.ndarray:
        return np.arange(self.order, -1, -1)

    @cached_property
    def _factorials(self) -> np.ndarray:
        return np.array([math.factorial(k) for k in self._orders], dtype=float)


class LastPose:
    """Poses as they were measured last, with the velocity between the last two: what there is without a filter."""

    def start(self, measurement: PoseMeasured) -> PoseEstimate:
        """The estimate after the first measurement."""
        pose, zero = np.asarray(measurement.pose, dtype=float), np.zeros((1, 3))
        return PoseEstimate(
            measurement.time, pose[:3], _unit(pose[3:]), zero, zero, np.zeros((12, 12)), measurement.time
        )

    def predict(self, estimate: PoseEstimate, time: float) -> PoseEstimate:
        """The estimate at a later time [s]: the same."""
        return replace(estimate, time=time)

    reach = predict

    def correct(self, estimate: PoseEstimate, measurement: PoseMeasured) -> PoseEstimate:
        """The measurement, with the velocity since the one before."""
        new, dt = self.start(measurement), measurement.time - estimate.measured
        if dt <= 0.0:
            return new
        turn = log(multiply(new.rotation, inverse(estimate.rotation)))
        return replace(new, linear=(new.position - estimate.position)[None] / dt, angular=turn[None] / dt)


def _of_axes(block: np.ndarray) -> np.ndarray:
    """A matrix of one axis ``[n, n]`` for three ``[3 n, 3 n]``: its Kronecker product with the identity."""
    size = 3 * len(block)
    return (block[:, None, :, None] * _EYE[None, :, None, :]).reshape(size, size)


_EYE = np.eye(3)


def _unit(q: np.ndarray) -> np.ndarray:
    return q / np.linalg.norm(q)


UNIT = 0.5, 2.0
"""Least and largest norm of a measured quaternion; others are no rotations."""
MOVING = 0.1, 0.5
"""Velocity [m/s] and angular velocity [rad/s] from which on a thing does not have the same pose twice."""


class PoseEstimator:
    """Estimator of one thing from its measured poses.

    Args:
        name: The object, or robot with a free root.
        estimate: What the scene says of it; None for where it was measured last.
        scene: The scene.
        compiled: The scene, compiled.
    """

    def __init__(self, name: str, estimate: Estimate | None, scene: Scene, compiled: CompiledScene):
        key = f"plant.sensor.pose.{name}" if estimate is None else f"estimate.{name}"
        self.name, self._joint = name, FreeJoint.of(compiled.layout, name, key=key)
        self.history: History[PoseEstimate, PoseMeasured]
        if estimate is None:
            self.history = History(LastPose())
        else:
            self.history = History(PoseFilter(estimate))
        self.reset()
        start = State.start(compiled.layout)
        self._start = start.joint_q[self._joint.q], start.joint_qd[self._joint.qd]

    def reset(self) -> None:
        """Forget every measurement."""
        self.history.reset()
        self._last: tuple[np.ndarray | None, int] = (None, 0)  # pose, and how often it was the same

    def update(self, measurement: Measurement) -> bool:
        """Take in a pose of this thing, if it is plausible; return whether it was taken."""
        if not isinstance(measurement, PoseMeasured) or measurement.name != self.name:
            return False
        taken = plausible(measurement, 7, {"pose": FARTHEST})
        if taken is None or not UNIT[0] <= float(np.linalg.norm(taken.pose[3:])) <= UNIT[1] or self._frozen(taken):
            return False
        self.history.insert(taken)
        return True

    def _frozen(self, measurement: PoseMeasured) -> bool:
        """Return whether a pose is that of before but for its time, again, though the thing moves."""
        last, count = self._last
        count = count + 1 if last is not None and np.array_equal(last, measurement.pose) else 0
        self._last = measurement.pose, count
        found = self.history.at(measurement.time) if count > 1 else None
        return found is not None and (
            np.linalg.norm(found.linear[0]) > MOVING[0] or np.linalg.norm(found.angular[0]) > MOVING[1]
        )

    def trusted(self, time: float) -> bool:
        """Return whether the estimate can be believed: the filter's gate looks at every pose."""
        return True

    def fill(self, state: State) -> State:
        """The state with the pose and velocity of this thing at its time; those of its start before a measurement."""
        found, joint = self.history.at(float(state.time)), self._joint
        coordinates, velocities = self._start
        if found is not None:
            coordinates = joint.coordinates(found.position, found.rotation)
            velocities = joint.velocities(found.rotation, found.linear[0], found.angular[0])
        q, qd = (np.array(array, dtype=np.float32) for array in (state.joint_q, state.joint_qd))
        q[joint.q], qd[joint.qd] = coordinates, velocities
        return replace(state, joint_q=q, joint_qd=qd)


class SceneEstimator:
    """All estimators of a scene, one for each thing in ``estimate``, ``estimate_base`` or with a sensor of its pose.

    Args:
        scene: The scene.
        compiled: The scene, compiled.

    Raises:
        SceneError: If something that is measured or estimated does not exist or is not free.
    """

    def __init__(self, scene: Scene, compiled: CompiledScene):
        names = dict.fromkeys((*scene.estimate, *scene.plant.sensor.pose))
        self.parts: tuple[Estimator, ...] = (
            *(BaseEstimator(name, known, compiled) for name, known in scene.estimate_base.items()),
            *(PoseEstimator(name, scene.estimate.get(name), scene, compiled) for name in names),
        )
        """Estimators, in the order in which they fill a state."""

    def reset(self) -> None:
        """Forget every measurement."""
        for part in self.parts:
            part.reset()

    def update(self, measurement: Measurement) -> bool:
        """Take in a measurement; return whether an estimator took it."""
        return any(part.update(measurement) for part in self.parts)

    def trusted(self, time: float) -> bool:
        """Return whether everything that is estimated at a time [s] can be believed."""
        return all(part.trusted(time) for part in self.parts)

    def fill(self, state: State) -> State:
        """The state with what is estimated for its time."""
        for part in self.parts:
            state = part.fill(state)
        return state
