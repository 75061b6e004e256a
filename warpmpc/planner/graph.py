# SPDX-License-Identifier: Apache-2.0
"""A whole plan as one step from host to host: one copy in, one copy out, on CUDA a single captured graph between."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..engine.trajectory import ObservedState
from ..kernels.worlds.exchange import REPORT, report_kernel, unpack_observation_kernel
from .weighting import BLOCK_DIM

if TYPE_CHECKING:
    from .plan import PlanStep


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
        layout, envs, terms = plan.layout, plan.shape.envs, len(plan.costs.labels)
        self._nq, self._nv, self._nu = layout.nq, layout.nv, layout.nu
        wide, reported = layout.nq + layout.nv + 7, layout.nu + int(REPORT) + terms
        cuda = self.device.is_cuda

        def host(columns: int) -> wp.array:
            return wp.zeros((envs, columns), dtype=float, device="cpu", pinned=cuda)

        def device(columns: int) -> wp.array:
            return wp.zeros((envs, columns), dtype=float, device=self.device)

        self._host_in, self._host_out = host(wide), host(reported)
        self._in, self._out = device(wide), device(reported)
        self.state = ObservedState(device(layout.nq), device(layout.nv))
        self._packed, self._report = self._host_in.numpy(), self._host_out.numpy()
        self.captured: wp.Graph | None = None
        self.capturable = cuda and plan.costs.capturable

    @property
    def stages(self) -> dict[str, float]:
        """Wall time of each stage of the last plan [s]; NaN where a graph runs them all as one."""
        return self.plan.stages if self.captured is None else dict.fromkeys(self.plan.stages, float("nan"))

    def __call__(self, joint_q: np.ndarray, joint_qd: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Plan.

        Args:
            joint_q: Joint coordinates ``[E, nq]``.
            joint_qd: Joint velocities ``[E, nv]``.
            goal: Goal poses ``[E, 7]``.

        Returns:
            A row per environment, ``[E, nu + 6 + terms]``: command, β, η, cost and index of the best sample, diverged
            worlds, capacity bits, discounted cost of each term of the best sample. Overwritten by the next plan.
        """
        self._packed[:, : self._nq] = joint_q
        self._packed[:, self._nq : -7] = joint_qd
        self._packed[:, -7:] = goal
        if self.captured is not None:
            wp.capture_launch(self.captured)
        else:
            self._sequence()
            if self.capturable:
                with wp.ScopedCapture(device=self.device) as capture:
                    self._sequence()
                self.captured = capture.graph
        wp.synchronize_device(self.device)
        return self._report

    def _sequence(self) -> None:
        plan, trajectory = self.plan, self.plan.engine.trajectory
        envs = self._in.shape[0]
        wp.copy(self._in, self._host_in)
        wp.launch(
            unpack_observation_kernel,
            dim=envs,
            inputs=[self._in],
            outputs=[self.state.joint_q, self.state.joint_qd, plan.costs.goal],
            device=self.device,
        )
        plan(self.state)
        wp.launch_tiled(
            report_kernel,
            dim=[envs],
            inputs=[
                plan.command,
                plan.weights.beta,
                plan.weights.eta,
                plan.weights.cost,
                plan.costs.cost,
                trajectory.diverged,
                trajectory.overflow,
                plan.shape.domains,
                plan.planner.discount,
            ],
            outputs=[self._out],
            block_dim=BLOCK_DIM,
            device=self.device,
        )
        wp.copy(self._host_out, self._out)
