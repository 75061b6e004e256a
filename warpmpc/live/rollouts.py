# SPDX-License-Identifier: Apache-2.0
"""Rollouts of the last plan: paths to draw, and the cost of the cheapest one step by step."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..controller.rollout_paths import RolloutPaths, acting_frames, see_rollouts
from .forecast import Forecast, Forecaster

if TYPE_CHECKING:
    from ..controller.controller import Controller


class ShownRollouts:
    """Looks at rollouts of a controller's last plan."""

    paths: RolloutPaths | None
    """Paths to draw; None where no rollout survived."""
    forecast: Forecast | None
    """Cost ahead of the cheapest rollout; None likewise."""

    def __init__(self, controller: Controller):
        self._controller = controller
        self._frames = acting_frames(controller.scene, controller.layout)
        self._forecaster = Forecaster(controller)
        self.clear()

    def clear(self) -> None:
        """There is nothing to see."""
        self.paths = self.forecast = None

    def update(self) -> None:
        """See what the last plan came to."""
        found = see_rollouts(self._controller, self._frames)
        if found is None:
            self.clear()
            return
        seen, self.paths = found
        self.forecast = self._forecaster(seen)


def segments(paths: np.ndarray) -> np.ndarray:
    """Lines ``[..., T+1, 3]`` cut into pieces ``[n, 2, 3]``."""
    return np.stack([paths[..., :-1, :], paths[..., 1:, :]], axis=-2).reshape(-1, 2, 3)
