# SPDX-License-Identifier: Apache-2.0
"""Measurements, with the time at which they were made, and what estimates states from them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Protocol

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ..model.state import State


@dataclass(frozen=True)
class PoseMeasured:
    """A measured pose in the world."""

    order: ClassVar[int] = 0
    """Place among measurements of one thing and time."""
    name: str
    """Object, or robot with a free root."""
    time: float
    """Time at which it was there [s]."""
    pose: np.ndarray
    """Pose of its body (x, y, z, qx, qy, qz, qw) ``[7]``."""


@dataclass(frozen=True)
class ImuMeasured:
    """Angular velocity and acceleration that an inertial measurement unit shows, in its own frame."""

    order: ClassVar[int] = 0
    """Place among measurements of one thing and time: before joints, which correct what it carries forward."""
    name: str
    """Robot."""
    time: float
    """Time of the measurement [s]."""
    gyro: np.ndarray
    """Angular velocity ``[3]`` [rad/s]."""
    accel: np.ndarray
    """Proper acceleration ``[3]`` [m/s²]: at rest that against gravity."""


@dataclass(frozen=True)
class JointsMeasured:
    """Joints of a robot with one axis each, as measured, in the layout's order."""

    order: ClassVar[int] = 1
    """Place among measurements of one thing and time."""
    name: str
    """Robot."""
    time: float
    """Time of the measurement [s]."""
    q: np.ndarray
    """Coordinates ``[n]`` [m, rad]."""
    qd: np.ndarray
    """Velocities ``[n]`` [m/s, rad/s]."""
    effort: np.ndarray
    """Forces and torques of their drives ``[n]`` [N, N·m]."""


Measurement = PoseMeasured | ImuMeasured | JointsMeasured

FARTHEST = 1e5
"""Largest coordinate of anything measured [m, rad]; larger ones are no measurements."""
LATEST = 1e12
"""Largest time of a measurement on either side of zero [s]."""


def plausible(measurement: Measurement, size: int, largest: Mapping[str, float | np.ndarray]) -> bool:
    """Return whether a measurement has the right size and its numbers are finite and in their range.

    Args:
        measurement: The measurement.
        size: Length of each of its arrays.
        largest: Bounds of absolute values, by the name of the array.
    """
    arrays = {name: np.asarray(getattr(measurement, name)) for name in largest}
    sound = np.size(measurement.time) == 1 and abs(measurement.time) <= LATEST
    return bool(
        sound
        and all(array.shape == (size,) and array.dtype.kind in "fiu" for array in arrays.values())
        and all((np.abs(array) < largest[name]).all() for name, array in arrays.items())
    )


class Estimator(Protocol):
    """Source of parts of a state that nothing observes as they are."""

    def update(self, measurement: Measurement) -> bool:
        """Take in a measurement, late or out of order; return whether it is plausible and estimated here."""

    def trusted(self, time: float) -> bool:
        """Return whether what is estimated at a time [s] can be believed."""

    def fill(self, state: State) -> State:
        """The state with what is estimated for its time in place of those parts."""

    def reset(self) -> None:
        """Forget every measurement."""
