# SPDX-License-Identifier: Apache-2.0
"""Cost of the last plan's cheapest rollout at every step, term by term."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np

from ..cost.stack import CostEvaluator
from ..launch import capturing
from ..model.batch_size import BatchSize
from ..model.trajectory import Trajectory

if TYPE_CHECKING:
    from ..controller.controller import Controller
    from ..task.observed import ObservedState


@dataclass(frozen=True)
class Forecast:
    """The cheapest rollout ahead; arrays are copies."""

    times: np.ndarray
    """Begin of every step ``[T]`` [s]."""
    cost: np.ndarray
    """Weighted cost of every term and step, not discounted ``[terms, T]``; NaN where it is not finite."""
    control: np.ndarray
    """Controls ``[T, nu]``."""


class TrajectoryCosts:
    """Evaluates one recorded rollout step by step, with the terms, resources and weights of the last plan.

    Args:
        controller: The controller.
        times: Begin of every step and end of the last after the first ``[T+1]`` [s].
        state: Start of the rollout.
    """

    def __init__(self, controller: Controller, times: np.ndarray, state: ObservedState):
        costs, shape = controller.costs, BatchSize(1, 1, 1, len(times) - 1)
        with capturing:
            self._out = Trajectory.allocate(shape, controller.layout, len(costs.pairs), controller.device)
            self._evaluator = CostEvaluator(costs, self._out, self._out.control, state, shape, times)

    def __call__(self, seen: Trajectory) -> np.ndarray:
        """Compute the weighted cost of every term and step, not discounted ``[terms, T]``.

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
        return self._evaluator.cost.numpy()[:, :, 0].astype(float)


class Forecaster:
    """Evaluates the cheapest rollout step by step."""

    def __init__(self, controller: Controller):
        self._controller, planner = controller, controller.plan_step
        self._costs = TrajectoryCosts(controller, planner.grid.t, planner.state)

    def __call__(self, seen: Trajectory) -> Forecast:
        """Compute the cost ahead.

        Args:
            seen: Recorded rollouts on the host; the first of them is evaluated.
        """
        cost = self._costs(seen)
        return Forecast(
            times=self._controller.info.time + self._controller.plan_step.grid.t[:-1],
            cost=np.where(np.isfinite(cost), cost, np.nan),
            control=seen.control[:, 0].copy(),
        )
