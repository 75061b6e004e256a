# SPDX-License-Identifier: Apache-2.0
"""Rollouts of the last plan: paths to draw, and the cost of the cheapest one step by step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..record.rollout_paths import acting_frames, choose_rollouts, paths_of
from .forecast import Forecast, Forecaster

if TYPE_CHECKING:
    from ..controller.controller import Controller


@dataclass(frozen=True)
class RolloutPaths:
    """Paths of the acting frames."""

    best: np.ndarray
    """The cheapest rollout ``[F, T+1, 3]`` [m]."""
    others: np.ndarray
    """Others ``[n, F, T+1, 3]`` [m]."""
    colors: np.ndarray
    """Colours of the others by cost ``[n, 3]``, 0 to 255."""


class ShownRollouts:
    """Looks at rollouts of a controller's last plan."""

    paths: RolloutPaths | None
    """Paths to draw; None where no rollout survived."""
    forecast: Forecast | None
    """Cost ahead of the cheapest rollout; None likewise."""

    def __init__(self, controller: Controller):
        self._controller = controller
        self._body, self._place = acting_frames(controller)
        self._forecaster = Forecaster(controller)
        self.clear()

    def clear(self) -> None:
        """There is nothing to see."""
        self.paths = self.forecast = None

    def update(self) -> None:
        """See what the last plan came to."""
        controller = self._controller
        worlds, packed = choose_rollouts(controller)
        if not len(worlds):
            self.clear()
            return
        seen = controller.engine.record(worlds)
        paths = paths_of(seen.body_q[:, :, self._body], self._place)  # [1+n, F, T+1, 3]
        colors = np.stack([(packed >> shift) & 0xFF for shift in (24, 16, 8)], axis=1).astype(np.uint8)
        self.paths = RolloutPaths(paths[0], paths[1:], colors)
        self.forecast = self._forecaster(seen)


def segments(paths: np.ndarray) -> np.ndarray:
    """Lines ``[..., T+1, 3]`` cut into pieces ``[n, 2, 3]``."""
    return np.stack([paths[..., :-1, :], paths[..., 1:, :]], axis=-2).reshape(-1, 2, 3)
