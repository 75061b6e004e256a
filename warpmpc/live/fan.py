# SPDX-License-Identifier: Apache-2.0
"""What rollouts of the last plan come to: ways to draw, and what the cheapest one costs step by step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..record.recorder import COLORS, acting_frames
from ..record.shapes import rotate
from .forecast import Forecast, Forecaster

if TYPE_CHECKING:
    from ..controller.controller import Controller

FAN = 24
"""Sampled rollouts to draw, spread evenly over the costs' ranking."""


@dataclass(frozen=True)
class Ways:
    """Ways of the acting frames."""

    best: np.ndarray
    """The cheapest rollout ``[F, T+1, 3]`` [m]."""
    fan: np.ndarray
    """Others ``[n, F, T+1, 3]`` [m]."""
    colors: np.ndarray
    """Colours of the others by cost ``[n, 3]``, 0 to 255."""


class Fan:
    """Looks at rollouts of a controller's last plan.

    Args:
        controller: The controller.
    """

    ways: Ways | None
    """What to draw; None where no rollout survived."""
    forecast: Forecast | None
    """What the cheapest rollout comes to; None likewise."""

    def __init__(self, controller: Controller):
        self._controller = controller
        self._body, self._place = acting_frames(controller)
        self._forecaster = Forecaster(controller)
        self.clear()

    def clear(self) -> None:
        """There is nothing to see."""
        self.ways = self.forecast = None

    def look(self) -> None:
        """See what the last plan came to."""
        controller = self._controller
        cost = controller.engine.cost.numpy()[0]
        ranked = np.argsort(cost)
        ranked = ranked[np.isfinite(cost[ranked])]
        if not len(ranked):
            self.clear()
            return
        chosen = ranked[np.linspace(0, len(ranked) - 1, min(FAN, len(ranked))).astype(int)]
        high = cost[ranked[int(0.9 * (len(ranked) - 1))]]
        cheap = np.clip((high - cost[chosen]) / max(high - cost[ranked[0]], 1e-9), 0.0, 1.0)
        packed = COLORS[(cheap * (len(COLORS) - 1)).astype(int)]
        worlds = np.concatenate([[controller.info.best], chosen * controller.shape.domains])
        seen = controller.engine.record(worlds)
        pose = seen.body_q[:, :, self._body]  # [T+1, 1+n, F, 7]
        ways = (pose[..., :3] + rotate(pose[..., 3:], self._place)).transpose(1, 2, 0, 3).astype(np.float32)
        colors = np.stack([(packed >> shift) & 0xFF for shift in (24, 16, 8)], axis=1).astype(np.uint8)
        self.ways = Ways(ways[0], ways[1:], colors)
        self.forecast = self._forecaster(seen)


def segments(ways: np.ndarray) -> np.ndarray:
    """Lines ``[..., T+1, 3]`` cut into pieces ``[n, 2, 3]``."""
    return np.stack([ways[..., :-1, :], ways[..., 1:, :]], axis=-2).reshape(-1, 2, 3)
