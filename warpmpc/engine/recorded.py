# SPDX-License-Identifier: Apache-2.0
"""Engines that record every rollout and judge it afterwards."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import warp as wp

from ..cost.stack import Judge
from ..kernels.planning.splines import Spline, spline_control_kernel
from ..kernels.planning.weights import CVAR, MEAN, WORST, explain_cost_kernel, risk_kernel, sum_cost_kernel
from ..scene.schema import Risk

if TYPE_CHECKING:
    import numpy as np

    from ..cost.stack import CostStack
    from ..scene.schema import Planner
    from ..task.observed import ObservedState
    from .timegrid import TimeGrid
    from .trajectory import Shape, Simulator

RISKS = {Risk.MEAN: MEAN, Risk.WORST: WORST, Risk.CVAR: CVAR}


class RecordedEngine:
    """Rolls knots out with a simulator, records everything and applies the cost terms to the record.

    On the CPU a thread takes some worlds through all of it in one go, while others take theirs.

    Args:
        simulator: Steps the worlds.
        costs: The cost terms.
        state: What rollouts start from; its arrays are read at every call.
        shape: Sizes of the batch.
        grid: Times and weights of the steps.
        spline: Spline from knots to controls.
        limits: Lower and upper limits of the controls on the device, ``[nu]`` each.
        planner: Says how costs of several domains become one.
    """

    cost: wp.array2d[float]
    """Cost of every sample, +inf where it diverged, ``[E, S]``."""
    term_cost: wp.array2d[float]
    """What each term added to the cost of the sample asked for last, ``[E, term]``."""

    def __init__(
        self,
        simulator: Simulator,
        costs: CostStack,
        state: ObservedState,
        shape: Shape,
        grid: TimeGrid,
        spline: Spline,
        limits: tuple[wp.array, wp.array],
        planner: Planner,
    ):
        self.simulator, self.costs, self.state, self.shape = simulator, costs, state, shape
        self.name, self.device = simulator.name, simulator.device
        self.grid, self._spline, self._limits = grid.arrays(self.device), spline, limits
        nu, envs = len(limits[0]), shape.envs
        self.control = wp.zeros((shape.horizon, shape.worlds, nu), dtype=float, device=self.device)
        self.judge = Judge(costs, simulator.trajectory, self.control, state, shape, grid.t)
        self._risk = [shape.domains, RISKS[planner.risk], planner.cvar]
        step_place = (grid.t[:-1] / grid.dt[0]).astype("float32") * (grid.dt[:1].astype("float32") / spline.knot_dt)
        self._step_place = wp.array(step_place, dtype=float, device=self.device)
        self._rollout_cost = wp.zeros(shape.worlds, dtype=float, device=self.device)
        self.cost = wp.zeros((envs, shape.samples), dtype=float, device=self.device)
        self.term_cost = wp.zeros((envs, len(costs.terms)), dtype=float, device=self.device)

    @property
    def diverged(self) -> wp.array:
        """Nonzero where a world's physics failed, ``[W]``."""
        return self.simulator.trajectory.diverged

    @property
    def overflow(self) -> wp.array:
        """Capacity bits of every world, ``[W]``."""
        return self.simulator.trajectory.overflow

    @property
    def capturable(self) -> bool:
        """Whether a CUDA graph can hold an evaluation."""
        return wp.get_device(self.device).is_cuda and self.costs.capturable

    def begin(self) -> None:
        """Start from the observed state: resources follow it, every world is put into it; capture-safe."""
        self.costs.before_plan(self.state)
        self.simulator.clone(self.state)

    def evaluate(self, knots: wp.array, offset: wp.array) -> None:
        """Roll knots out and judge them, into :attr:`cost`; capture-safe where :attr:`capturable`.

        Args:
            knots: Knots ``[E, S, P, nu]``.
            offset: Time from the first knot to the present ``[E]`` [s].
        """
        self.simulator.run(lambda first, count: self._roll_out(knots, offset, first, count))
        if not self.costs.capturable:
            self.judge.launch_arrays()
            self._sum(0, self.shape.worlds)
        self._launch(
            risk_kernel,
            self.cost.shape,
            [self._rollout_cost, self.state.observed, *self._risk],
            [self.cost],
        )

    def _roll_out(self, knots: wp.array, offset: wp.array, first: int, count: int) -> None:
        """Take some worlds from knots to costs."""
        self._launch(
            spline_control_kernel,
            (self.shape.horizon, count),
            [
                knots,
                self._spline,
                *self._limits,
                self.grid.t,
                self._step_place,
                offset,
                self.shape.domains,
                first,
            ],
            [self.control],
        )
        self.simulator.rollout(self.control, first, count)
        self.judge.launch(first, count)
        self._sum(first, count)

    def _sum(self, first: int, count: int) -> None:
        self._launch(
            sum_cost_kernel,
            (count,),
            [self.judge.cost, self.diverged, self.grid.weight, first],
            [self._rollout_cost],
        )

    def explain(self, sample: wp.array) -> None:
        """Write what each term added to the cost of a sample of every environment ``[E]``; capture-safe."""
        self._launch(
            explain_cost_kernel,
            self.term_cost.shape,
            [self.judge.cost, self._rollout_cost, sample, self.grid.weight, self.shape.samples, *self._risk],
            [self.term_cost],
        )

    def record(self, worlds: Sequence[int]) -> np.ndarray:
        """Body poses ``[T+1, n, nb, 7]`` of some worlds of the last evaluation, on the host."""
        return self.simulator.trajectory.body_q.numpy()[:, list(worlds)]

    def _launch(self, kernel: wp.Kernel, dim: tuple[int, ...], inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)

    def overflow_message(self, bits: int) -> str:
        """What overflowed and which setting to raise."""
        return self.simulator.overflow_message(bits)

    def close(self) -> None:
        """Release threads and memory."""
        self.simulator.close()
