# SPDX-License-Identifier: Apache-2.0
"""Rollouts under a feedback policy: every candidate of a line search is a world that steps with the others."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ...kernels.planner.feedback import add_cost_kernel, follow_kernel
from ...physics.runtime.launch import Launcher, capturing, unrecorded
from ...physics.tangent import Tangent

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ...engine.protocol import Engine, EngineRequest, PhysicsSteps
    from .residuals import Residuals


@dataclass(frozen=True)
class Policy:
    """u_t = ū_t + α k_t + K_t (x_t ⊖ x̄_t) + ε_t, of every environment."""

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
    """States and controls of the candidates in the first of their worlds, and their mean costs."""

    state: np.ndarray
    """``[E, N, T+1, nx]``, the start first."""
    control: np.ndarray
    """``[E, N, T, nu]``, within the limits."""
    cost: np.ndarray
    """``[E, N]``, infinite where the physics failed."""


class PolicyRollouts:
    """Rolls policies out, each with several α, at once.

    Args:
        engine: Engine of the plans.
        request: What it was built for.
        steps: Physics steps of the horizon.
        residuals: Residuals of the terms.
        candidates: N.
        policies: P, the most policies of an environment.
        draws: D, worlds with their own properties that each candidate is tried in, as ``request.properties`` lists
            them for all N·D worlds of an environment.
        hold: Steps that a control is held for; changes and gains of their first one count.
    """

    def __init__(
        self,
        engine: Engine,
        request: EngineRequest,
        steps: PhysicsSteps,
        residuals: Residuals,
        candidates: int,
        *,
        policies: int = 1,
        draws: int = 1,
        hold: int = 1,
    ):
        self._hold, self._policies, self._draws = hold, policies, draws
        device, layout = request.device, request.costs.layout
        self.worlds = worlds = engine.step_worlds(request, steps, candidates * draws, residuals)
        self.tangent = tangent = Tangent(worlds.model)
        self._launch, self._candidates = Launcher(device), candidates
        self._envs, self._horizon, self._residuals = request.shape.envs, request.shape.horizon, residuals
        envs, steps_, nx, n, nu = self._envs, self._horizon, tangent.width, tangent.size, layout.nu
        count = worlds.shape.worlds

        def zeros(*shape: int) -> wp.array:
            return wp.zeros(shape, dtype=wp.float64, device=device)

        each = envs * policies
        self._state, self._control, self._change = (zeros(each, steps_, k) for k in (nx, nu, nu))
        tried = candidates * draws
        self._gain, self._share, self._feedback = zeros(each, steps_, nu, n), zeros(tried), zeros(tried)
        self._followed = wp.zeros(tried, dtype=int, device=device)
        self._states, self._controls, self._cost = zeros(steps_ + 1, count, nx), zeros(steps_, count, nu), zeros(count)
        self._difference = zeros(count, n)
        self._noise = zeros(count, steps_, nu)
        self._table = tangent.table(device)
        self._limits = [
            wp.array(limit, dtype=wp.float64, device=device) for limit in (layout.control_lower, layout.control_upper)
        ]
        norms = [wp.clone(array, device=device) for array in residuals.norm_arrays]
        self._costing = [*norms, request.weights, request.scene.planner.stage_risk]
        self._replays = worlds.replays(self._roll)

    @unrecorded
    def set_limits(self, lower: np.ndarray, upper: np.ndarray) -> None:
        """Change the limits of the controls ``[nu]``."""
        for array, limit in zip(self._limits, (lower, upper), strict=True):
            array.assign(limit)

    def __call__(
        self,
        start: np.ndarray,
        before: np.ndarray,
        policies: Sequence[Policy],
        share: np.ndarray,
        feedback: np.ndarray | float = 1.0,
        followed: np.ndarray | int = 0,
        noise: np.ndarray | float = 0.0,
    ) -> Outcome:
        """Roll policies out.

        Args:
            start: States at the start ``[E, nx]``.
            before: Controls that acted before ``[E, nu]``.
            policies: The policies, at most P.
            share: α of each candidate ``[N]``.
            feedback: How much of K each candidate has ``[N]``.
            followed: The policy that each candidate follows ``[N]``.
            noise: ε of each world, broadcast to ``[E, N, D, T, nu]``.
        """
        worlds, shape = self.worlds, (self._envs, self._candidates, self._draws)
        count = self._candidates * self._draws
        begin = np.repeat(start, count, axis=0)
        applied = np.stack([before, before]).repeat(count, axis=1)

        def each(values: np.ndarray | float, kind: type) -> np.ndarray:
            """A number of every candidate for all its worlds."""
            return np.broadcast_to(np.asarray(values, dtype=kind), share.shape).repeat(self._draws)

        with capturing:
            worlds.follow()
            rest = [policies[0]] * (self._policies - len(policies))
            for name in ("state", "control", "change", "gain"):
                values = np.stack([getattr(policy, name) for policy in (*policies, *rest)], axis=1)
                getattr(self, f"_{name}").assign(values.reshape(-1, *values.shape[2:]))
            self._share.assign(each(share, float))
            self._feedback.assign(each(feedback, float))
            self._followed.assign(each(followed, np.int32))
            self._noise.assign(np.broadcast_to(noise, (*shape, *self._noise.shape[1:])).reshape(self._noise.shape))
            worlds.starts.assign(np.hstack([np.zeros((len(begin), 1)), begin]))
            worlds.applied.assign(applied.astype(np.float32))
        worlds.run(self._replays)
        with capturing:
            states = self._states.numpy().swapaxes(0, 1).reshape(*shape, self._horizon + 1, -1)
            controls = self._controls.numpy().swapaxes(0, 1).reshape(*shape, self._horizon, -1)
            cost = self._cost.numpy().reshape(shape).mean(axis=2)
            return Outcome(states[:, :, 0].copy(), controls[:, :, 0].copy(), cost)

    def _roll(self, part: int) -> None:
        worlds, (first, count) = self.worlds, self.worlds.parts[part]
        policy = [self._state, self._control, self._change, self._gain, self._share, self._feedback]
        for t in range(self._horizon + 1):
            which = [len(self._share), self._hold, self._policies, self._followed, self._noise]
            inputs = [t, first, *which, self._table, worlds.ends, *policy, *self._limits]
            outputs = [worlds.starts, self._difference, self._states, self._controls, worlds.applied]
            self._launch(follow_kernel, count, inputs, outputs)
            if t < self._horizon:
                worlds.take(part)
                inputs = [t, first, len(self._share), worlds.residuals, *self._costing, worlds.diverged]
                self._launch(add_cost_kernel, count, inputs, [self._cost])

    def close(self) -> None:
        """Stop the threads."""
        self.worlds.close()
