# SPDX-License-Identifier: Apache-2.0
"""Times of the steps of a horizon, and their discount."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..scene.schema import Growing

if TYPE_CHECKING:
    from ..scene.schema import Scene


@dataclass(frozen=True)
class TimeGrid:
    """T steps from the present on, and their arrays on the device of the rollouts.

    Args:
        dt: Length of each step ``[T]`` [s].
        discount: γ_t, the factor on what each step costs ``[T]``.
    """

    dt: np.ndarray
    discount: np.ndarray

    @classmethod
    def of(cls, scene: Scene) -> TimeGrid:
        """The time grid of a scene's planner: γ^t [P5], the last step times ``planner.terminal`` [S3]."""
        planner, steps = scene.planner, scene.planner.horizon
        match planner.dt:
            case None:
                dt = np.full(steps, scene.timing.control_dt)
            case Growing(first=first, last=last, constant=constant):
                grow = np.linspace(first, last, max(steps - constant + 1, 2))[1:]
                dt = np.concatenate([np.full(constant, first), grow])[:steps]
            case values:
                dt = np.array(values) if len(values) > 1 else np.full(steps, values[0])
        # a running product in the precision of the device
        discount = np.cumprod([1.0, *[planner.discount] * (steps - 1)], dtype=np.float32)
        discount[-1] *= planner.terminal
        return cls(dt.astype(np.float64), discount)

    @property
    def steps(self) -> int:
        """Number of steps T."""
        return len(self.dt)

    @property
    def even(self) -> bool:
        """True where all steps are equally long."""
        return bool(np.all(self.dt == self.dt[0]))

    @property
    def t(self) -> np.ndarray:
        """Times of the states after the present ``[T+1]`` [s], zero first."""
        if self.even:
            return self.dt[0] * np.arange(self.steps + 1)
        return np.concatenate([[0.0], np.cumsum(self.dt)])

    def arrays(self, device: str) -> TimeGridArrays:
        """The grid on a device."""

        def array(values: np.ndarray) -> wp.array:
            return wp.array(values, dtype=float, device=device)

        return TimeGridArrays(array(self.t), array(self.dt))


@dataclass(frozen=True)
class TimeGridArrays:
    """A time grid on a device."""

    t: wp.array  # [T+1] [s]
    dt: wp.array  # [T] [s]
