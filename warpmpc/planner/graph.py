# SPDX-License-Identifier: Apache-2.0
"""A whole plan as one step from host to host: one copy in, one copy out, on CUDA a single captured graph between."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..kernels.worlds.exchange import (
    REPORT,
    best_sample_kernel,
    count_failures_kernel,
    report_kernel,
    unpack_kernel,
)
from ..launch import Launcher, Replay
from .weighting import BLOCK_DIM

if TYPE_CHECKING:
    from .step import PlanStep


@dataclass(frozen=True)
class PlanReport:
    """What came of a plan; views of the block that was copied back, overwritten by the next plan."""

    command: np.ndarray  # [E, nu]
    beta: np.ndarray  # [E]
    eta: np.ndarray  # [E]
    cost: np.ndarray  # [E] of the best sample, +inf when every sample diverged
    best: np.ndarray  # [E] sample
    diverged: np.ndarray  # [E] worlds whose physics failed
    overflow: np.ndarray  # [E] capacity bits of all worlds together
    terms: np.ndarray  # [E, terms] of the best sample
    knots: np.ndarray  # [E, P, nu] of the plan
    offset: np.ndarray  # [E] time from the first knot to the present [s]


class PlanGraph:
    """Runs a plan step on packed observations and reports what came of it.

    On a CUDA device the first plan runs launch by launch, which loads the kernels; then the same sequence is captured
    and later plans replay it. Terms that are plain functions over arrays cannot be captured: with one of them every
    plan runs launch by launch.

    Args:
        plan: The plan step.
    """

    def __init__(self, plan: PlanStep):
        self.plan = plan
        self.device = wp.get_device(plan.device)
        self._launch = Launcher(self.device)
        envs, terms = plan.shape.envs, len(plan.costs.labels)
        cuda = self.device.is_cuda
        self._nu, self._terms, self._knots = plan.command.shape[1], terms, plan.strategy.mean.shape
        state = plan.state
        widths = [3, state.joint_q.shape[1], state.joint_qd.shape[1], state.act.shape[1], 7 * state.mocap.shape[1]]
        widths.append(plan.costs.task.block.shape[1])
        self._parts = np.cumsum([0, *widths])

        def host(columns: int) -> wp.array:
            return wp.zeros((envs, columns), dtype=float, device="cpu", pinned=cuda)

        def device(columns: int) -> wp.array:
            return wp.zeros((envs, columns), dtype=float, device=self.device)

        wide = int(self._parts[-1])
        reported = self._nu + int(REPORT) + terms + self._knots[1] * self._nu + 1
        self._host_in, self._host_out, self._in, self._out = host(wide), host(reported), device(wide), device(reported)
        self._packed, self._report = self._host_in.numpy(), self._host_out.numpy()
        self._best = wp.zeros(envs, dtype=int, device=self.device)
        self._best_cost = wp.zeros(envs, dtype=float, device=self.device)
        self._failures = wp.zeros((envs, 2), dtype=int, device=self.device)
        pieces = (self._unpack, self._pack)
        self._take_in, self._give_out = pieces if cuda else [Replay(piece, blocks=True) for piece in pieces]
        self.captured: wp.Graph | None = None
        self.capturable = plan.capturable

    @property
    def stages(self) -> dict[str, float]:
        """Wall time of each stage of the last plan [s]; NaN where a graph runs them all as one."""
        return self.plan.stages if self.captured is None else dict.fromkeys(self.plan.stages, float("nan"))

    def __call__(
        self,
        observed: np.ndarray,
        elapsed: np.ndarray,
        start: np.ndarray,
        joint_q: np.ndarray,
        joint_qd: np.ndarray,
        act: np.ndarray,
        mocap: np.ndarray,
    ) -> PlanReport:
        """Plan for what the task wants at present.

        Args:
            observed: Whether there is an observation to plan from ``[E]``.
            elapsed: Time since the last plan ``[E]`` [s].
            start: Time of the observation ``[E]`` [s].
            joint_q: Joint coordinates ``[E, nq]``.
            joint_qd: Joint velocities ``[E, nv]``.
            act: Activations ``[E, na]``.
            mocap: Poses of mocap bodies ``[E, nm, 7]``.
        """
        head = np.stack([observed, elapsed, start], axis=1)
        envs = len(head)
        blocks = (head, joint_q, joint_qd, act, mocap.reshape(envs, -1), self.plan.costs.task.block)
        for block, first, end in zip(blocks, self._parts, self._parts[1:], strict=False):
            self._packed[:, first:end] = block
        self.plan.costs.refresh()
        if self.captured is not None:
            wp.capture_launch(self.captured)
        else:
            self._sequence()
            if self.capturable:
                with wp.ScopedCapture(device=self.device) as capture:
                    self._sequence()
                self.captured = capture.graph
        if self.device.is_cuda:
            wp.synchronize_device(self.device)
        return self._unpacked()

    def _unpacked(self) -> PlanReport:
        row, nu = self._report, self._nu
        numbers = row[:, nu : nu + int(REPORT)].T
        at = nu + int(REPORT)
        low, high = numbers[5].astype(np.int64), numbers[6].astype(np.int64)
        return PlanReport(
            command=row[:, :nu],
            beta=numbers[0],
            eta=numbers[1],
            cost=numbers[2],
            best=numbers[3],
            diverged=numbers[4],
            overflow=low | high << 16,
            terms=row[:, at : at + self._terms],
            knots=row[:, at + self._terms : -1].reshape(self._knots),
            offset=row[:, -1],
        )

    def _sequence(self) -> None:
        self._take_in()
        self.plan()
        self._give_out()

    def _unpack(self) -> None:
        """Spread the block that came in over the arrays of the plan."""
        state = self.plan.state
        wp.copy(self._in, self._host_in)
        task = [state.pose, state.scalar, state.weight]
        observed = [state.observed, state.elapsed, state.start, state.joint_q, state.joint_qd, state.act, state.mocap]
        self._launch(unpack_kernel, self._in.shape[0], [self._in], observed + task)

    def _pack(self) -> None:
        """Gather what came of the plan into the block that goes out."""
        plan, strategy, engine = self.plan, self.plan.strategy, self.plan.engine
        envs = self._in.shape[0]
        outputs = [self._best, self._best_cost]
        self._launch(best_sample_kernel, envs, [engine.cost], outputs, block_dim=BLOCK_DIM)
        engine.explain(self._best)
        self._failures.zero_()
        inputs = [engine.diverged, engine.overflow, plan.shape.rollouts]
        self._launch(count_failures_kernel, plan.shape.worlds, inputs, [self._failures])
        learned = [plan.command, strategy.beta, strategy.eta, self._best, self._best_cost]
        about = [self._failures, engine.term_cost, strategy.mean, strategy.offset]
        self._launch(report_kernel, envs, learned + about, [self._out])
        wp.copy(self._host_out, self._out)
