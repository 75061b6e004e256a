# SPDX-License-Identifier: Apache-2.0
"""Splines over the knots of a plan: their tables for kernels, and their values on the host.

From controls over the horizon to knots of a plan, for all that proposes samples.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..engine.protocol import TimeGrid
from ..kernels.planner import splines as kernels
from ..scene.model.state import State
from ..scene.schema import SplineKind

if TYPE_CHECKING:
    from ..scene.schema import Scene


def spline_table(kind: SplineKind, time: np.ndarray, step: float, device: str) -> kernels.Spline:
    """Table of a spline, as kernels take it.

    Args:
        time: Times of the knots after the first ``[P]`` [s], ascending from zero.
        step: How long a single knot holds [s].
    """
    interval = np.diff(time) if len(time) > 1 else np.array([step])
    table = kernels.Spline()
    table.kind = int(getattr(kernels, kind.name))
    table.even = int(np.allclose(interval, interval[0], rtol=1e-9))
    table.knot_dt = float(interval[0])
    relative = np.ones_like(interval) if table.even else interval / interval[0]
    table.time = wp.array(time, dtype=float, device=device)
    table.interval = wp.array(np.append(relative, relative[-1])[: max(len(time), 1)], dtype=float, device=device)
    return table


def spline_value(kind: SplineKind, times: np.ndarray, knots: np.ndarray, time: float) -> np.ndarray:
    """Value of a spline at a time, as ``evaluate_spline`` of the kernels has it (Howell et al. 2022, Eqs. 15-23).

    Args:
        times: Times of the knots ``[P]`` [s], ascending.
        knots: Knots ``[P, nu]``.
        time: When [s]; before the first and after the last knot the end value is held.
    """
    last = len(times) - 1
    if last == 0:
        return knots[0]
    if kind is SplineKind.ZERO:
        early = float(kernels.KNOT_TOLERANCE) * (times[1] - times[0])
        return knots[min(max(int(np.searchsorted(times, time + early, side="right")) - 1, 0), last)]
    i = min(max(int(np.searchsorted(times, time, side="right")) - 1, 0), last - 1)  # np.clip takes long for one number
    length = float(times[i + 1] - times[i])
    x = min(max(float(time - times[i]) / length, 0.0), 1.0)
    if kind is SplineKind.LINEAR:
        return (1.0 - x) * knots[i] + x * knots[i + 1]
    if kind is SplineKind.CUBIC:
        a, b = (2.0 * x - 3.0) * x * x + 1.0, ((x - 2.0) * x + 1.0) * x
        c, d = (3.0 - 2.0 * x) * x * x, (x - 1.0) * x * x
        slope = [_slope(times, knots, j) * length for j in (i, i + 1)]
        return a * knots[i] + b * slope[0] + c * knots[i + 1] + d * slope[1]
    ends = [2.0 * knots[0] - knots[1], *knots, 2.0 * knots[-1] - knots[-2]]
    y = 1.0 - x
    weights = (y**3, (3.0 * x - 6.0) * x * x + 4.0, 1.0 + 3.0 * x * (1.0 + x - x * x), x**3)
    return sum(w * ends[i + k] for k, w in enumerate(weights)) / 6.0


def fitted_knots(kind: SplineKind, knot_time: np.ndarray, values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Knots ``[..., P, nu]`` whose spline comes nearest to values at some times, in the least-squares sense.

    Args:
        knot_time: Times of the knots ``[P]`` [s].
        values: Values ``[..., T, nu]``.
        times: Times of the values ``[T]`` [s].
    """
    return (fitting_matrix(kind, knot_time, times) @ values).astype(np.float32)


def fitting_matrix(kind: SplineKind, knot_time: np.ndarray, times: np.ndarray) -> np.ndarray:
    """The matrix ``[P, T]`` that turns values at some times into the knots whose spline comes nearest to them.

    Args:
        knot_time: Times of the knots ``[P]`` [s].
        times: Times of the values ``[T]`` [s].
    """
    corners = np.eye(len(knot_time))
    return np.linalg.pinv(np.stack([spline_value(kind, knot_time, corners, t) for t in times]))


def _slope(times: np.ndarray, knots: np.ndarray, j: int) -> np.ndarray:
    """Mean of the slopes on both sides of a knot, one-sided at the ends (Howell et al. 2022, Eqs. 17 and 18)."""
    sides = [k for k in (j - 1, j) if 0 <= k < len(times) - 1]
    return sum((knots[k + 1] - knots[k]) / (times[k + 1] - times[k]) for k in sides) / len(sides)


Ask = Callable[[State, Mapping[str, "np.ndarray | float"]], "np.ndarray | None"]
"""``(state, task) -> knots [n, P, nu]``, or None where there is nothing to propose."""


class Horizon:
    """Turns controls over the horizon into knots of a plan.

    Args:
        knot_time: Times of the knots after the first ``[P]`` [s].
    """

    def __init__(self, scene: Scene, knot_time: np.ndarray, nu: int):
        self.nu, self.knot_time, self.time = nu, knot_time, TimeGrid.of(scene).t[:-1]
        """Times at which the steps begin ``[T]`` [s]."""
        self.kind = scene.planner.spline
        self._matrix = fitting_matrix(self.kind, knot_time, self.time)

    @property
    def shapes(self) -> list[str]:
        """Shapes of a sequence of controls."""
        return [f"[{count}, {self.nu}]" for count in dict.fromkeys((len(self.time), len(self.knot_time)))]

    def knots(self, controls: np.ndarray) -> np.ndarray:
        """Knots ``[n, P, nu]`` of controls ``[n, T, nu]``, the nearest ones, or of knots as they are."""
        if controls.ndim != 3 or controls.shape[2] != self.nu:
            raise ValueError
        if controls.shape[1] == len(self.knot_time):
            return controls
        if controls.shape[1] != len(self.time):
            raise ValueError
        return self._matrix @ controls

    def proposed(self, controls: object, samples: int) -> np.ndarray:
        """Knots ``[n, P, nu]`` of what a function or a policy returned.

        Args:
            controls: One control for the whole horizon ``[nu]``, or a sequence; a list of n of those where n is not 1.
            samples: How many are expected, n.
        """
        values = np.asarray(controls, dtype=np.float64)
        if samples == 1 and values.shape == (self.nu,):
            values = np.broadcast_to(values, (len(self.knot_time), self.nu))
        if samples == 1 and values.ndim == 2:
            values = values[None]
        if values.ndim != 3 or len(values) != samples:
            raise ValueError(f"returns an array {list(np.shape(controls))}")
        try:
            return self.knots(values)
        except ValueError:
            raise ValueError(f"returns an array {list(np.shape(controls))}") from None

    def allowed(self, samples: int) -> str:
        """Shapes that may be returned, in words."""
        if samples > 1:
            return " or ".join(f"[{samples}, {shape[1:]}" for shape in self.shapes)
        return " or ".join([f"[{self.nu}]", *self.shapes])
