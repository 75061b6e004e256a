# SPDX-License-Identifier: Apache-2.0
"""A whole plan as one step from host to host: one copy in, one copy out, on CUDA a single captured graph between."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..kernels.worlds.packing import REPORT, report_kernel, survey_kernel, unpack_kernel
from ..launch import Launcher, Replay, step_lanes
from .report import PlanReport
from .weighting import block_dim

LANES = 32
"""Threads of a GPU that share an environment's numbers."""

if TYPE_CHECKING:
    from .step import PlanStep


class PlanGraph:
    """Runs a plan step on packed observations and reports what came of it.

    On a CUDA device the first plan runs launch by launch, which loads the kernels; then the same sequence is captured
    and later plans replay it. Terms that are plain functions over arrays cannot be captured: with one of them every
    plan runs launch by launch. With derivatives all before them is one graph, rollouts under feedback and differences
    one each, and the host works between them.
    """

    def __init__(self, plan: PlanStep):
        self.plan = plan
        self.device = wp.get_device(plan.device)
        self._launch = Launcher(self.device)
        self._kept: list[wp.array] = []
        envs, terms = plan.shape.envs, len(plan.costs.labels)
        cuda = self.device.is_cuda
        self._nu, self._terms, self._knots = plan.command.shape[1], terms, plan.strategy.mean.shape
        state = plan.state
        widths = [3, state.joint_q.shape[1], state.joint_qd.shape[1], state.act.shape[1], 7 * state.mocap.shape[1]]
        self._observed_columns = slice(3, sum(widths))
        widths += [state.proposed.shape[1], plan.costs.task.block.shape[1]]

        reported = self._nu + int(REPORT) + terms + self._knots[1] * self._nu + 1
        self._packed, self._in = self._packed_arrays(envs, sum(widths))
        self._report, self._out = self._packed_arrays(envs, reported)
        self._lanes = step_lanes(LANES, self.device)
        self._best = wp.zeros(envs, dtype=int, device=self.device)
        self._best_cost = wp.zeros(envs, dtype=float, device=self.device)
        self._failures = wp.zeros((envs, 2), dtype=int, device=self.device)
        self._planned = self._views()
        pieces = (self._unpack, self._pack)
        self._take_in, self._give_out = pieces if cuda else [Replay(piece, blocks=True) for piece in pieces]
        self.captured: wp.Graph | None = None
        self.capturable = plan.capturable

    @property
    def stages(self) -> dict[str, float]:
        """Wall time of each stage of the last plan [s]; NaN where a graph runs them all as one."""
        return self.plan.stages if self.captured is None else dict.fromkeys(self.plan.stages, float("nan"))

    @property
    def task(self) -> np.ndarray:
        """Values of the task that the last plan was made for ``[E, n]``, overwritten by the next."""
        return self._packed[:, -self.plan.costs.task.block.shape[1] :]

    def __call__(self, observed: np.ndarray, elapsed: np.ndarray, start: np.ndarray, state: np.ndarray) -> PlanReport:
        """Plan for what the task wants at present.

        Args:
            observed: Whether there is an observation to plan from ``[E]``.
            elapsed: Time since the last plan ``[E]`` [s].
            start: Time of the observation ``[E]`` [s].
            state: Joint coordinates, joint velocities, activations, poses of mocap bodies ``[E, nq + nv + na + 7 nm]``.
        """
        packed, task = self._packed, self.plan.costs.task.block
        packed[:, 0], packed[:, 1], packed[:, 2] = observed, elapsed, start
        seen = self._observed_columns
        packed[:, seen] = state
        packed[:, seen.stop : -task.shape[1]] = self.plan.ancillaries(observed, start, state, self._planned)
        packed[:, -task.shape[1] :] = task
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
        return self._planned

    def _packed_arrays(self, envs: int, columns: int) -> tuple[np.ndarray, wp.array]:
        """A block ``[E, columns]`` that host and device both see: a GPU reads and writes the host's pinned memory."""
        host = wp.zeros((envs, columns), dtype=float, device="cpu", pinned=self.device.is_cuda)
        self._kept.append(host)
        if not self.device.is_cuda:
            return host.numpy(), host
        return host.numpy(), wp.array(ptr=host.ptr, shape=host.shape, dtype=float, device=self.device)

    def _views(self) -> PlanReport:
        row, nu = self._report, self._nu
        numbers, at = row[:, nu : nu + int(REPORT)].T, nu + int(REPORT)
        return PlanReport(
            command=row[:, :nu],
            beta=numbers[0],
            eta=numbers[1],
            cost=numbers[2],
            best=numbers[3],
            diverged=numbers[4],
            overflow_halves=numbers[5:],
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
        observed = [state.observed, state.elapsed, state.start, state.joint_q, state.joint_qd, state.act]
        task = [_numbers(state.pose), state.scalar, state.weight]
        outputs = [*observed, _numbers(state.mocap), state.proposed, *task]
        self._launch(unpack_kernel, self._in.shape, [self._in], outputs)

    def _pack(self) -> None:
        """Gather what came of the plan into the block that goes out."""
        plan, strategy, engine = self.plan, self.plan.strategy, self.plan.engine
        envs = self._in.shape[0]
        inputs, outputs = [engine.cost, engine.diverged, engine.overflow], [self._best, self._best_cost, self._failures]
        self._launch(survey_kernel, envs, inputs, outputs, block_dim=block_dim(engine.cost.shape[1]))
        engine.explain(self._best)
        numbers = [plan.command, strategy.beta, strategy.eta, self._best, self._best_cost]
        arrays = [self._failures, engine.term_cost, strategy.mean, strategy.offset]
        self._launch(report_kernel, (envs, self._lanes), [*numbers, *arrays, self._lanes], [self._out])


def _numbers(poses: wp.array) -> wp.array:
    """The same memory of poses ``[E, n]`` as numbers ``[E, 7 n]``."""
    envs, count = poses.shape
    return wp.array(ptr=poses.ptr, shape=(envs, 7 * count), dtype=float, device=poses.device)
