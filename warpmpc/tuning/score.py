# SPDX-License-Identifier: Apache-2.0
"""The value of an episode to a tuning; less is better."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from ..controller.controller import Controller
    from ..plant.plant import Plant
    from ..run.result import EpisodeResult
    from ..scene.schema import Scene

GRAZE_FORCE = 5.0
"""Net force up to which a touched obstacle counts as grazed [N]."""
GRAZE_TIME = 0.1
"""Time in contact up to which it does [s]."""
FARTHEST = 2.0
"""Final errors beyond this many start errors count as this many."""


@dataclass(frozen=True)
class Outcome:
    """An episode of a trial."""

    value: float
    """Its value: seconds where the scene has a ``success``, else cost."""
    passed: bool
    """True when it ended as it should."""


class Score:
    """Values an episode; its ``on_step`` sums what the terms cost at the scene's own weights.

    Args:
        scene: The scene before tuned values, whose tolerances and weights judge all trials alike.
        plant: The episode's plant, before its first step.
        contact_penalty: Price of contact beyond a graze [s].
    """

    def __init__(self, scene: Scene, plant: Plant, *, contact_penalty: float):
        self.scene, self.plant, self.contact_penalty = scene, plant, contact_penalty
        self._weights = {cost.label: cost.weight for cost in scene.cost}
        self._start = plant.error
        self._paid, self._worst = 0.0, -math.inf

    def __call__(self, controller: Controller, plant: Plant, control: np.ndarray) -> None:
        """Add up the cost of the step just made."""
        if self.scene.success is None:
            cost = sum(self._weights[label] * value for label, value in plant.terms.items())
            self._paid, self._worst = self._paid + cost, max(self._worst, cost)

    def outcome(self, result: EpisodeResult) -> Outcome:
        """The episode's outcome.

        With a ``success``, an episode that reaches it is worth its time to the goal. A failure is worth at least twice
        the timeout, plus the timeout times the share of the start error that is left, in position and, where success
        asks for it, in orientation (of π). So a near miss is better than a far one, and any success better than both.
        Contact beyond a graze adds a penalty. Without a ``success`` the value is the mean cost at the scene's own
        weights; steps that a failure cut off cost as much as the worst.
        """
        return Outcome(self._seconds(result) if self.scene.success else self._mean_cost(), result.passed)

    def _mean_cost(self) -> float:
        steps = max(round(self.scene.timing.timeout / self.scene.timing.control_dt), self.plant.steps, 1)
        cut = steps - self.plant.steps
        mean = (self._paid + (cut * self._worst if cut else 0.0)) / steps
        return mean if math.isfinite(mean) else 1e30

    def _seconds(self, result: EpisodeResult) -> float:
        hard = result.max_force > GRAZE_FORCE and result.time_in_contact > GRAZE_TIME
        price = self.contact_penalty * hard
        if result.success:
            return result.time_to_goal + price
        success, end = self.scene.success, self.plant.error
        if end is None:
            return self.scene.timing.timeout * 3.0 + price
        tolerance = success.distance or max(success.position or (0.0,))
        left = _share(end.position, max(self._start.position, tolerance, 1e-3))
        if success.yaw is not None:
            left += _share(end.yaw, math.pi)
        elif success.rotation is not None:
            left += _share(end.rotation, math.pi)
        return self.scene.timing.timeout * (2.0 + left) + price


def _share(error: float, whole: float) -> float:
    """Share of a whole that is left; an error without a value is the worst."""
    return min(error / whole, FARTHEST) if math.isfinite(error) else FARTHEST
