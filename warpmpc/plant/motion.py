# SPDX-License-Identifier: Apache-2.0
"""Things that move by themselves in a simulated plant: true and observed positions."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import PchipInterpolator

if TYPE_CHECKING:
    from ..scene.schema import Motion, Scene

SLACK = 1e-6
"""Tolerance of lapses of time [s]: times are sums of steps."""


class MotionPath:
    """Path of one thing over time.

    Monotone between points along every axis (Fritsch and Carlson 1980): nothing is overshot, and what waits stands.

    Args:
        motion: What the scene says of it.
    """

    def __init__(self, motion: Motion):
        points, self._period, self._start = np.array(motion.through, dtype=float), motion.period, motion.start
        count = len(points)
        times = np.arange(count) * self._period / count if motion.times is None else np.array(motion.times)
        if self._period is not None:  # three rounds, so that the middle one has neither beginning nor end
            times = np.concatenate([times + turn * self._period for turn in (-1, 0, 1)])
            points = np.tile(points, (3, 1))
        self._first, self._last = times[0], times[-1]
        self._curve = PchipInterpolator(times, points)

    def __call__(self, time: float) -> np.ndarray:
        """Position ``[3]`` at a time [s]."""
        t = max(time - self._start, 0.0)
        t = min(t, self._last) if self._period is None else t % self._period
        return self._curve(t)


class Observer:
    """Observations of one thing that moves.

    Args:
        motion: What the scene says of it.
        control_dt: Length of a control [s].
        seed: Seed of the observations' noise.
    """

    def __init__(self, motion: Motion, control_dt: float, seed: list[int]):
        self.name, self.path, self._seen = motion.name, MotionPath(motion), motion.seen
        self._rate, self._seed = motion.seen.rate or 1.0 / control_dt, seed
        self.reset()

    def reset(self) -> None:
        """Forget what was observed, and begin the noise anew."""
        self._rng, self._count = np.random.default_rng(self._seed), -1
        self._rows: deque[tuple[float, np.ndarray]] = deque(maxlen=max(2, round(self._seen.over * self._rate)))

    def __call__(self, time: float) -> np.ndarray:
        """Position that the planner is shown ``[3]`` at a time [s], which never goes back."""
        count = int((time + SLACK) * self._rate)
        if count > self._count:
            self._count = count
            at = count / self._rate
            self._rows.append((at, self.path(at) + self._rng.normal(0.0, self._seen.noise, 3)))
        if self._seen.lead == 0.0 or len(self._rows) < 2:
            return self._rows[-1][1]
        times, positions = map(np.array, zip(*self._rows, strict=True))
        ago = times - times.mean()
        velocity = ago @ positions / (ago @ ago)
        return positions.mean(axis=0) + velocity * (time + self._seen.lead - times.mean())


class Motions:
    """All that moves by itself in one plant.

    Args:
        scene: The scene.
        seed: Seed of the observations' noise.
    """

    def __init__(self, scene: Scene, seed: int):
        dt = scene.timing.control_dt
        self._observers = [Observer(motion, dt, [seed, 2, i]) for i, motion in enumerate(scene.motion)]

    def reset(self) -> None:
        """Go back to the beginning."""
        for observer in self._observers:
            observer.reset()

    def at(self, time: float) -> dict[str, np.ndarray]:
        """Positions of everything ``[3]``, by name."""
        return {observer.name: observer.path(time) for observer in self._observers}

    def seen(self, time: float) -> dict[str, np.ndarray]:
        """Positions that the planner is shown ``[3]``, by name."""
        return {observer.name: observer(time) for observer in self._observers}
