# SPDX-License-Identifier: Apache-2.0
"""Cost of the last plan's cheapest rollout at every step, term by term."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np

from ..cost.stack import CostEvaluator
from ..launch import capturing
from ..model.trajectory import Trajectory

if TYPE_CHECKING:
    from ..controller.controller import Controller


@dataclass(frozen=True)
class Forecast:
    """The cheapest rollout ahead; arrays are copies."""

    times: np.ndarray
    """Begin of every step ``[T]`` [s]."""
    cost: np.ndarray
    """Weighted cost of every term and step, not discounted ``[terms, T]``; NaN where it is not finite."""
    control: np.ndarray
    """Controls ``[T, nu]``."""


class Forecaster:
    """Evaluates the cheapest rollout step by step, with the terms, resources and weights that the plan had."""

    def __init__(self, controller: Controller):
        self._controller = controller
        costs, shape = controller.costs, replace(controller.shape, envs=1, samples=1, domains=1)
        with capturing:
            self._out = Trajectory.allocate(shape, controller.layout, len(costs.pairs), controller.device)
            planner = controller.plan_step
            self._evaluator = CostEvaluator(costs, self._out, self._out.control, planner.state, shape, planner.grid.t)

    def __call__(self, seen: Trajectory) -> Forecast:
        """Compute the cost ahead.

        Args:
            seen: Recorded rollouts on the host; the first of them is evaluated.
        """
        for field in fields(Trajectory):
            values = getattr(seen, field.name)
            first = values[:1] if values.ndim == 1 else values[:, :1]
            with capturing:
                getattr(self._out, field.name).assign(np.ascontiguousarray(first))
        self._evaluator.launch()
        self._evaluator.launch_arrays()
        cost = self._evaluator.cost.numpy()[:, :, 0].astype(float)
        start = self._controller.info.time
        return Forecast(
            times=start + self._controller.plan_step.grid.t[:-1],
            cost=np.where(np.isfinite(cost), cost, np.nan),
            control=seen.control[:, 0].copy(),
        )
