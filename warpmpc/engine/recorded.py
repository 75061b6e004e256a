# SPDX-License-Identifier: Apache-2.0
"""Engines that record every rollout and judge it afterwards."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

import warp as wp

from ..cost.stack import Judge
from ..kernels.planning.costs import (
    BEST,
    CVAR,
    EXPONENTIAL,
    MEAN,
    VAR,
    WORST,
    explain_cost_kernel,
    risk_kernel,
    sum_cost_kernel,
)
from ..kernels.planning.splines import Spline, spline_control_kernel
from ..launch import Launcher, Replay, step_lanes
from ..scene.schema import Risk

if TYPE_CHECKING:
    from ..cost.stack import CostStack
    from ..model.batch_size import BatchSize
    from ..model.trajectory import Trajectory
    from ..scene.schema import Planner
    from ..task.observed import ObservedState
    from .protocol import Proposal, Simulator
    from .timegrid import TimeGrid

RISKS = {
    Risk.MEAN: MEAN,
    Risk.WORST: WORST,
    Risk.BEST: BEST,
    Risk.CVAR: CVAR,
    Risk.VAR: VAR,
    Risk.EXPONENTIAL: EXPONENTIAL,
}


def risk_inputs(planner: Planner, domains: int) -> list[int | float]:
    """What kernels take of the risk over domains: how many there are, the mode, its share α or its R."""
    of_mode = planner.aversion if planner.risk is Risk.EXPONENTIAL else planner.cvar
    return [domains, RISKS[planner.risk], of_mode]


class RecordedEngine:
    """Rolls knots out with a simulator, records everything and applies the cost terms to the record.

    On the CPU a thread takes some worlds through all of it in one go, from sampling to costs, while others take theirs.

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
        shape: BatchSize,
        grid: TimeGrid,
        spline: Spline,
        limits: tuple[wp.array, wp.array],
        planner: Planner,
    ):
        self.simulator, self.costs, self.state, self.shape = simulator, costs, state, shape
        self.name, self.device = simulator.name, simulator.device
        self._launch = Launcher(self.device)
        self._on_gpu = wp.get_device(self.device).is_cuda
        self._replays: dict[int, tuple[Proposal, list[Replay]]] = {}
        self.grid, self._spline, self._limits = grid.arrays(self.device), spline, limits
        envs = shape.envs
        self.control = simulator.trajectory.control
        self.judge = Judge(costs, simulator.trajectory, self.control, state, shape, grid.t)
        self._risk, self._stage_risk = risk_inputs(planner, shape.domains), planner.stage_risk
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

    def evaluate(self, proposal: Proposal) -> None:
        """Roll proposed knots out from the observed state and judge them, into :attr:`cost`.

        Capture-safe but for terms over whole arrays. On the CPU every part of the worlds is a sequence of its own,
        replayed by whatever thread takes it.
        """
        if self._on_gpu:
            self._take(proposal, 0)
        else:
            if id(proposal) not in self._replays:
                parts = [p for p, part in enumerate(self.simulator.parts) if self._tries(proposal.samples, *part)]
                self._replays[id(proposal)] = proposal, [Replay(partial(self._take, proposal, p)) for p in parts]
            _, replays = self._replays[id(proposal)]
            self.simulator.run(replays)
        if not self.costs.capturable:
            self.judge.launch_arrays()
            self._sum(0, self.shape.worlds)

    def _tries(self, samples: int, first: int, count: int) -> bool:
        """Whether some worlds have any of the first samples of an environment among them."""
        rollouts = self.shape.rollouts
        wanted = samples * self.shape.domains
        return first % rollouts < wanted or first // rollouts != (first + count - 1) // rollouts

    def _take(self, proposal: Proposal, part: int) -> None:
        """Take a part of the worlds from the observed state to the costs of its samples."""
        shape, (first, count) = self.shape, self.simulator.parts[part]
        proposal.sample(first // shape.domains, count // shape.domains)
        self.simulator.clone(self.state, first, count)
        lanes = step_lanes(shape.horizon, self.device)
        places = [self.grid.t, self._step_place, proposal.offset, shape.domains, first, lanes]
        self._launch(
            spline_control_kernel,
            (lanes, count),
            [proposal.knots, self._spline, *self._limits, *places],
            [self.control],
        )
        self.simulator.rollout_part(self.control, part)
        self.judge.launch(first, count)
        self._sum(first, count)

    def _sum(self, first: int, count: int) -> None:
        """Costs of some worlds' samples from what their terms cost at every step."""
        inputs = [self.judge.cost, self.diverged, self.grid.weight, self._stage_risk, first]
        self._launch(sum_cost_kernel, count, inputs, [self._rollout_cost])
        domains = self.shape.domains
        inputs = [self._rollout_cost, self.state.observed, *self._risk, first // domains]
        self._launch(risk_kernel, count // domains, inputs, [self.cost])

    def explain(self, sample: wp.array) -> None:
        """Write what each term added to the cost of a sample of every environment ``[E]``; capture-safe."""
        weighing = [self.grid.weight, self._stage_risk]
        self._launch(
            explain_cost_kernel,
            self.term_cost.shape,
            [self.judge.cost, self._rollout_cost, sample, *weighing, self.shape.samples, *self._risk],
            [self.term_cost],
        )

    def record(self, worlds: Sequence[int]) -> Trajectory:
        """What became of some worlds in the last evaluation, on the host."""
        return self.simulator.trajectory.of_worlds(worlds)

    def overflow_message(self, bits: int) -> str:
        """What overflowed and which setting to raise."""
        return self.simulator.overflow_message(bits)

    def close(self) -> None:
        """Release threads and memory."""
        self.simulator.close()
