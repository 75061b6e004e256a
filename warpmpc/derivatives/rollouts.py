# SPDX-License-Identifier: Apache-2.0
"""Rollouts under a feedback policy: every candidate of a line search is a world that steps with the others."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..kernels.planning.feedback import add_cost_kernel, follow_kernel
from ..launch import Launcher
from .tangent import Tangent

if TYPE_CHECKING:
    from ..engine.protocol import Engine
    from ..engine.request import EngineRequest, PhysicsSteps
    from .residuals import Residuals


@dataclass(frozen=True)
class Policy:
    """u_t = ū_t + α k_t + K_t (x_t ⊖ x̄_t), of every environment."""

    state: np.ndarray
    """Nominal states x̄ ``[E, T, nx]``."""
    control: np.ndarray
    """Nominal controls ū ``[E, T, nu]``."""
    change: np.ndarray
    """k ``[E, T, nu]``."""
    gain: np.ndarray
    """K ``[E, T, nu, n]``."""


@dataclass(frozen=True)
class Outcome:
    """States, controls and costs of the candidates."""

    state: np.ndarray
    """``[E, N, T+1, nx]``, the start first."""
    control: np.ndarray
    """``[E, N, T, nu]``, within the limits."""
    cost: np.ndarray
    """``[E, N]``, infinite where the physics failed."""


class PolicyRollouts:
    """Rolls a policy out with several α at once.

    Args:
        engine: Engine of the plans.
        request: What it was built for.
        steps: Physics steps of the horizon.
        residuals: Residuals of the terms.
        candidates: N.
        hold: Steps that a control is held for; changes and gains of their first one count.
    """

    def __init__(
        self,
        engine: Engine,
        request: EngineRequest,
        steps: PhysicsSteps,
        residuals: Residuals,
        candidates: int,
        hold: int = 1,
    ):
        self._hold = hold
        device, layout = request.device, request.costs.layout
        self.worlds = worlds = engine.step_worlds(request, steps, candidates, residuals)
        self.tangent = tangent = Tangent(worlds.model)
        self._launch, self._candidates = Launcher(device), candidates
        self._envs, self._horizon, self._residuals = request.shape.envs, request.shape.horizon, residuals
        envs, steps_, nx, n, nu = self._envs, self._horizon, tangent.width, tangent.size, layout.nu
        count = worlds.shape.worlds

        def zeros(*shape: int) -> wp.array:
            return wp.zeros(shape, dtype=wp.float64, device=device)

        self._state, self._control, self._change = (zeros(envs, steps_, k) for k in (nx, nu, nu))
        self._gain, self._share, self._feedback = zeros(envs, steps_, nu, n), zeros(candidates), zeros(candidates)
        self._states, self._controls, self._cost = zeros(steps_ + 1, count, nx), zeros(steps_, count, nu), zeros(count)
        self._difference = zeros(count, n)
        self._table = tangent.table(device)
        self._limits = [
            wp.array(limit, dtype=wp.float64, device=device) for limit in (layout.control_lower, layout.control_upper)
        ]
        norms = [wp.clone(array, device=device) for array in residuals.norm_arrays]
        self._costing = [*norms, request.weights, request.scene.planner.stage_risk]
        self._replays = worlds.replays(self._roll)

    def set_limits(self, lower: np.ndarray, upper: np.ndarray) -> None:
        """Change the limits of the controls ``[nu]``."""
        for array, limit in zip(self._limits, (lower, upper), strict=True):
            array.assign(limit)

    def __call__(
        self,
        start: np.ndarray,
        before: np.ndarray,
        policy: Policy,
        share: np.ndarray,
        feedback: np.ndarray | float = 1.0,
    ) -> Outcome:
        """Roll the policy out.

        Args:
            start: States at the start ``[E, nx]``.
            before: Controls that acted before ``[E, nu]``.
            policy: The policy.
            share: α of each candidate ``[N]``.
            feedback: How much of K each candidate has ``[N]``.
        """
        worlds, shape = self.worlds, (self._envs, self._candidates)
        worlds.follow()
        begin = np.repeat(start, self._candidates, axis=0)
        applied = np.stack([before, before]).repeat(self._candidates, axis=1)
        given = policy.state, policy.control, policy.change, policy.gain
        for array, values in zip((self._state, self._control, self._change, self._gain), given, strict=True):
            array.assign(values)
        self._share.assign(np.asarray(share, dtype=float))
        self._feedback.assign(np.broadcast_to(np.asarray(feedback, dtype=float), share.shape).copy())
        worlds.starts.assign(np.hstack([np.zeros((len(begin), 1)), begin]))
        worlds.applied.assign(applied.astype(np.float32))
        worlds.run(self._replays)
        states = self._states.numpy().swapaxes(0, 1).reshape(*shape, self._horizon + 1, -1)
        controls = self._controls.numpy().swapaxes(0, 1).reshape(*shape, self._horizon, -1)
        return Outcome(states.copy(), controls.copy(), self._cost.numpy().reshape(shape).copy())

    def _roll(self, part: int) -> None:
        """All steps of a part of the worlds."""
        worlds, (first, count) = self.worlds, self.worlds.parts[part]
        policy = [self._state, self._control, self._change, self._gain, self._share, self._feedback]
        for t in range(self._horizon + 1):
            inputs = [t, first, self._candidates, self._hold, self._table, worlds.ends, *policy, *self._limits]
            outputs = [worlds.starts, self._difference, self._states, self._controls, worlds.applied]
            self._launch(follow_kernel, count, inputs, outputs)
            if t < self._horizon:
                worlds.take(part)
                inputs = [t, first, self._candidates, worlds.residuals, *self._costing, worlds.diverged]
                self._launch(add_cost_kernel, count, inputs, [self._cost])

    def close(self) -> None:
        """Stop the threads."""
        self.worlds.close()
