# SPDX-License-Identifier: Apache-2.0
"""Measurements, with the time at which they were made, and what estimates states from them.

Measurements of the last time with the estimates after them, so that late ones come to stand where they belong.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Generic, Protocol, TypeVar

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from ...scene.model.state import State


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
Measured = TypeVar("Measured", PoseMeasured, ImuMeasured, JointsMeasured)

FARTHEST = 1e5
"""Largest coordinate of anything measured [m, rad]; larger ones are no measurements."""
LATEST = 1e12
"""Largest time of a measurement on either side of zero [s]."""


def plausible(measurement: Measured, size: int, largest: Mapping[str, float | np.ndarray]) -> Measured | None:
    """A copy of a measurement of the right size, with finite numbers in their range; None for any other.

    Args:
        measurement: The measurement.
        size: Length of each of its arrays.
        largest: Bounds of absolute values, by the name of the array.
    """
    arrays = {name: np.asarray(getattr(measurement, name)) for name in largest}
    sound = np.size(measurement.time) == 1 and abs(measurement.time) <= LATEST
    sound = (
        sound
        and all(array.shape == (size,) and array.dtype.kind in "fiu" for array in arrays.values())
        and all((np.abs(array) < largest[name]).all() for name, array in arrays.items())
    )
    if not sound:
        return None
    own = {name: array.astype(float) for name, array in arrays.items()}  # drivers use their arrays again
    return replace(measurement, time=float(np.asarray(measurement.time).reshape(())), **own)


MOST = {ImuMeasured: 4, JointsMeasured: 2, PoseMeasured: 20}
"""Measurements of each kind and thing that are taken in at a look where more came: it is to take a few milliseconds."""


def thinned(measurements: Sequence[Measurement]) -> list[Measurement]:
    """As many of some measurements as there is time for: of each source the last of as many groups, units' as means."""
    sources: dict[tuple[str, type], list[Measurement]] = {}
    for measured in measurements:
        sources.setdefault((measured.name, type(measured)), []).append(measured)
    kept: list[Measurement] = []
    for (_, kind), rows in sources.items():
        most, count = MOST.get(kind, len(rows)), len(rows)
        ends = [(k + 1) * count // most for k in range(most)] if count > most else range(1, count + 1)
        kept += [_mean(rows[first:end]) for first, end in zip([0, *ends], ends, strict=False)]
    return kept


def _mean(rows: Sequence[Measurement]) -> Measurement:
    """One measurement in place of some that follow each other: the last one; of a unit, which shows means, theirs."""
    last = rows[-1]
    parts = [np.asarray(part) for row in rows if isinstance(row, ImuMeasured) for part in (row.gyro, row.accel)]
    if len(rows) == 1 or not parts or any(part.shape != (3,) or part.dtype.kind not in "fiu" for part in parts):
        return last
    return replace(last, gyro=np.mean(parts[::2], axis=0), accel=np.mean(parts[1::2], axis=0))


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


Estimate = TypeVar("Estimate")
Taken = TypeVar("Taken")

KEPT = 1.0
"""Age of the oldest measurement that is kept, counted from the newest [s]."""


class Filter(Protocol[Estimate, Taken]):
    """Filter whose estimates are values with a ``time``."""

    def start(self, measurement: Taken) -> Estimate:
        """The estimate after the first measurement."""

    def predict(self, estimate: Estimate, time: float) -> Estimate:
        """The estimate at a later time [s]."""

    def correct(self, estimate: Estimate, measurement: Taken) -> Estimate:
        """The estimate with a measurement of its time."""

    def reach(self, estimate: Estimate, time: float) -> Estimate:
        """The estimate at a time [s] at which nothing was measured."""


class History(Generic[Estimate, Taken]):
    """Ring buffer of measurements of one thing, in the order of their times and of their kinds.

    A late one goes to its place and those after it are taken in again, so that the estimate is the one of measurements
    that came in order (Bar-Shalom 2002 calls it reprocessing). Of two of one kind and time the first counts.

    Args:
        filter: The filter.
    """

    most: float = np.inf
    """Measurements that are taken in again for a late one, at most; where they would be more, it is left out."""

    def __init__(self, filter: Filter[Estimate, Taken]):
        self.filter = filter
        self.reset()

    def reset(self) -> None:
        """Forget every measurement."""
        self._keys: list[tuple[float, float]] = []  # time and order
        self._measured: list[Taken] = []
        self._after: list[Estimate] = []
        self._whole = True  # whether the first measurement of all is among them
        self.too_late = 0
        """Measurements that were older than all that are kept, or than too many, and left out."""

    def insert(self, measurement: Taken) -> None:
        """Take in a measurement."""
        key = (measurement.time, measurement.order)
        place = bisect_right(self._keys, key)
        if place == 0 and not self._whole:
            self.too_late += 1
            return
        if place and self._keys[place - 1] == key:
            return
        if len(self._after) - place > self.most:
            self.too_late += 1
            return
        self._keys.insert(place, key)
        self._measured.insert(place, measurement)
        del self._after[place:]

    def _catch_up(self) -> None:
        """Take in what came since the last look: once, in any order."""
        for taken in self._measured[len(self._after) :]:
            self._after.append(self._with(taken))
        old = bisect_right(self._keys, (self._keys[-1][0] - KEPT, -np.inf)) if self._keys else 0
        if old:
            self._whole = False
            for rows in (self._keys, self._measured, self._after):
                del rows[:old]

    def _with(self, measurement: Taken) -> Estimate:
        if not self._after:
            return self.filter.start(measurement)
        return self.filter.correct(self.filter.predict(self._after[-1], measurement.time), measurement)

    def at(self, time: float) -> Estimate | None:
        """The estimate at a time [s] from what was measured until then, the first one before it; None without any."""
        self._catch_up()
        if not self._after:
            return None
        return self.filter.reach(self._after[max(bisect_right(self._keys, (time, np.inf)) - 1, 0)], time)
