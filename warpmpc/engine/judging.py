# SPDX-License-Identifier: Apache-2.0
"""Engines that take knots to costs in one launch: what they share."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..bake.number import native_lanes
from ..cost.kernel import JudgeCode, judge_code
from ..cost.stack import Judge
from ..cost.term import CostTerm
from ..kernels.planning.splines import ZERO
from ..kernels.worlds.judging import TAPS, TermSums, explain_total_kernel, finish_kernel, taps_kernel
from ..launch import Launcher, Replay
from ..model.batch_size import BatchSize
from ..model.trajectory import Trajectory
from .crew import Crew
from .recorded import risk_inputs

if TYPE_CHECKING:
    from .protocol import Proposal
    from .request import EngineRequest

PARTS = 4
"""Parts of the worlds per thread, as in the engine ``mujoco``."""


class JudgingEngine(ABC):
    """Rolls knots out and judges them in the same launch.

    A subclass says which terms its launch holds (:meth:`_stage`) and makes the launch (:meth:`_roll`).

    Args:
        request: What the engine is built for.
        work: ``wp.struct`` that its kernel takes, with the fields of :class:`~.kinematic_kernel.KinematicWork` that
            are filled here.
    """

    cost: wp.array2d[float]
    """Cost of every sample, +inf where it is not finite or the physics failed, ``[E, S]``."""
    term_cost: wp.array2d[float]
    """What each term added to the cost of the sample asked for last, ``[E, term]``."""
    diverged: wp.array[int]
    """Nonzero where the physics failed, or where there is none, where a cost is not finite, ``[W]``."""
    overflow: wp.array[int]
    """Capacity bits of every world, ``[W]``."""

    def __init__(self, request: EngineRequest, work: Any):
        self.request, self.device = request, request.device
        self.costs, self.shape, self.state = request.costs, request.shape, request.state
        self.layout = request.costs.layout
        self._launch, self._on_gpu = Launcher(self.device), wp.get_device(self.device).is_cuda
        self._replays: dict[int, tuple[Proposal, Replay, list[Replay]]] = {}
        self.lanes = native_lanes()
        planner = request.scene.planner
        self._risk, self._stage_risk = risk_inputs(planner, self.shape.domains), planner.stage_risk
        self._allocate(work)
        self._failed = self._zeros(0, dtype=int)
        """Worlds whose physics failed ``[W]``; empty where there is none."""
        self.parts = self._split(self.shape.samples)
        """First group of lanes, groups, first sample and samples of each part that a thread takes."""
        self._groups = 0 if self._on_gpu else -(-self.shape.rollouts // self.lanes)
        # rounds that try fewer samples may leave gaps, and a part more, between environments
        self._crew = Crew(min(self.threads, len(self.parts)), PARTS * self.threads + self.shape.envs)

    def _zeros(self, *dims: int, dtype: type = float) -> wp.array:
        return wp.zeros(dims, dtype=dtype, device=self.device)

    @property
    def threads(self) -> int:
        """CPU threads that share the samples."""
        return 1 if self._on_gpu else self.request.scene.engine.threads or len(os.sched_getaffinity(0))

    def _allocate(self, work: Any) -> None:
        request, shape, zeros = self.request, self.shape, self._zeros
        terms, steps, envs = len(self.costs.terms), shape.horizon, shape.envs
        self.cost, self.term_cost = zeros(envs, shape.samples), zeros(envs, terms)
        self.diverged, self.overflow = zeros(shape.worlds, dtype=int), zeros(shape.worlds, dtype=int)
        self._rollout_cost = zeros(shape.worlds)
        grid, spline = request.grid, request.spline
        self.grid = grid.arrays(self.device)
        place = (grid.t[:-1] / grid.dt[0]).astype("float32") * (grid.dt[:1].astype("float32") / spline.knot_dt)
        self._step_place = wp.array(place, dtype=float, device=self.device)
        knots = len(spline.time)
        self._unit = wp.array(np.eye(knots)[:, :, None], dtype=float, device=self.device)
        work.tap, work.share = zeros(envs, steps, int(TAPS), dtype=int), zeros(envs, steps, int(TAPS))
        work.lower, work.upper = request.limits
        state = self.state
        work.joint_q, work.joint_qd, work.mocap = state.joint_q, state.joint_qd, state.mocap
        self._work, self._sums = work, TermSums()
        sums = self._sums
        sums.dt, sums.step_weight = self.grid.dt, self.grid.weight
        sums.weight, sums.total = state.weight, zeros(terms, shape.worlds)
        # only knots that stand still between plans change their part in a step's control
        self._steps_of_plan = spline.kind == int(ZERO) and spline.even != 0
        self._taps(zeros(envs))

    def _stage(self, staged: list[int]) -> JudgeCode | None:
        """Make ready what terms need that are no part of the rollout's source: a record of all worlds, if any.

        Returns:
            Code of those terms that are kernels, if there are any.
        """
        shape, layout, work = self.shape, self.layout, self._work
        self.records = bool(staged)
        """Whether rollouts are recorded, because there are terms without baked source."""
        recorded = shape if staged else BatchSize(1, 1, 1, shape.horizon)
        self.recorded = out = Trajectory.allocate(recorded, layout, len(self.costs.pairs), self.device)
        work.record_q, work.record_qd = out.joint_q, out.joint_qd
        work.record_body_q, work.record_body_qd = out.body_q, out.body_qd
        work.control = out.control
        self.judge = Judge(self.costs, out, out.control, self.state, recorded, self.request.grid.t)
        self._staged = wp.array(staged, dtype=int, device=self.device)
        kernels = [(i, *self.costs.terms[i]) for i in staged if isinstance(self.costs.terms[i][0], CostTerm)]
        if not kernels:
            return None
        code = judge_code([(i, term) for i, term, _ in kernels])
        self._own = code.params()
        for i, _, bound in kernels:
            setattr(self._own, f"p{i}", bound)
        return code

    def _split(self, samples: int) -> list[tuple[int, int, int, int]]:
        """First group, groups, first sample and samples of each part that together try the first samples.

        Args:
            samples: How many of every environment; on the CPU whole registers of them, on a GPU all where there are
                several environments.
        """
        shape = self.shape
        if self._on_gpu:
            tried = samples if shape.envs == 1 else shape.envs * shape.samples
            return [(0, tried * shape.domains, 0, tried)]
        groups = -(-shape.rollouts // self.lanes)
        # all domains of a sample belong to one part
        whole = int(np.lcm(self.lanes, shape.domains)) // self.lanes
        blocks = -(-groups // whole)
        tried = -(-samples * shape.domains // (whole * self.lanes))
        count = tried * shape.envs
        size = count if self.threads == 1 else max(1, -(-count // (PARTS * self.threads)))

        def group(block: int) -> int:
            return block // blocks * groups + block % blocks * whole

        def sample(block: int) -> int:
            return block // blocks * shape.samples + block % blocks * whole * self.lanes // shape.domains

        parts = []
        # where all are tried, environments lie side by side without a gap
        runs = [(0, count)] if tried == blocks else [(e * blocks, e * blocks + tried) for e in range(shape.envs)]
        for begin, stop in runs:
            for first in range(begin, stop, size):
                end = min(first + size, stop)
                parts.append((group(first), group(end) - group(first), sample(first), sample(end) - sample(first)))
        return parts

    def evaluate(self, proposal: Proposal) -> None:
        """Roll proposed knots out from the observed state and judge them, into :attr:`cost`.

        Capture-safe on CUDA. On the CPU every part of the samples is a sequence of its own.
        """
        if self._on_gpu:
            if self._steps_of_plan:
                self._taps(proposal.offset)
            self._take(proposal, *self._split(proposal.samples))
        else:
            if id(proposal) not in self._replays:
                parts = [Replay(partial(self._take, proposal, part)) for part in self._split(proposal.samples)]
                self._replays[id(proposal)] = proposal, Replay(partial(self._taps, proposal.offset)), parts
            _, taps, parts = self._replays[id(proposal)]
            if self._steps_of_plan:
                taps()
            self._crew.run(parts)
        if not self.costs.capturable:
            self.judge.launch_arrays()
            self._finish(0, self.shape.envs * self.shape.samples)

    def _taps(self, offset: wp.array) -> None:
        """Which knots the controls depend on at present."""
        inputs = [self._unit, self.request.spline, self.grid.t, self._step_place, offset]
        self._launch(taps_kernel, self._work.tap.shape[:2], inputs, [self._work.tap, self._work.share])

    def _take(self, proposal: Proposal, part: tuple[int, int, int, int]) -> None:
        """Take a part of the samples from knots to costs."""
        first, groups, sample, samples = part
        proposal.sample(sample, samples)
        self._work.knots = proposal.knots
        self._roll(first, groups)
        self._finish(sample, samples)

    @abstractmethod
    def _roll(self, first: int, groups: int) -> None:
        """Roll some groups of lanes out, on a GPU all worlds, and judge them."""

    def _finish(self, first: int, count: int) -> None:
        """Costs of some samples from what their terms cost over the horizon."""
        weighing = [self.grid.weight, self._stage_risk]
        inputs = [self.judge.cost, self._staged, *weighing, self._failed, self.state.observed]
        outputs = [self._sums.total, self._rollout_cost, self.diverged, self.cost]
        self._launch(finish_kernel, count, [*inputs, *self._risk, first], outputs)

    def explain(self, sample: wp.array) -> None:
        """Write what each term added to the cost of a sample of every environment ``[E]``; capture-safe."""
        inputs = [self._sums.total, self._rollout_cost, sample, self.shape.samples, *self._risk]
        self._launch(explain_total_kernel, self.term_cost.shape, inputs, [self.term_cost])

    @property
    def total(self) -> wp.array:
        """Cost of each term of each world over the horizon ``[term, W]``."""
        return self._sums.total

    def close(self) -> None:
        """Stop the threads."""
        self._crew.close()
