# SPDX-License-Identifier: Apache-2.0
"""From controls over the horizon to knots of a plan, for all that proposes samples."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from ..engine.timegrid import TimeGrid
from ..model.state import State
from .splines import fitting_matrix

if TYPE_CHECKING:
    from ..scene.schema import Scene

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
        """Knots ``[n, P, nu]`` of controls ``[n, T, nu]``, the nearest ones, or of knots as they are.

        Raises:
            ValueError: If they are neither.
        """
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

        Raises:
            ValueError: If it is nothing of the kind; the message says what it is.
        """
        values = np.asarray(controls, dtype=np.float64)
        if samples == 1 and values.shape == (self.nu,):
            values = np.broadcast_to(values, (len(self.knot_time), self.nu))
        if samples == 1 and values.ndim == 2:
            values = values[None]
        if len(values) != samples or values.ndim != 3:
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
