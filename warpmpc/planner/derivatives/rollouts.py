# SPDX-License-Identifier: Apache-2.0
"""Rollouts under a feedback policy: every candidate of a line search is a world that steps with the others.

The tangent space of MuJoCo's states: differences and sums where orientations are quaternions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import warp as wp

from ...kernels.planner.derivatives import STRAIGHT
from ...kernels.planner.feedback import TURN, TangentTable, add_cost_kernel, follow_kernel
from ...physics.runtime.launch import Launcher, capturing, unrecorded

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ...engine.protocol import Engine, EngineRequest, PhysicsSteps
    from .residuals import Residuals


def _rotation(vector: np.ndarray) -> np.ndarray:
    """Quaternions (w, x, y, z) ``[..., 4]`` of rotation vectors ``[..., 3]``."""
    half = 0.5 * np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * vector], axis=-1)


def _vector(quaternion: np.ndarray) -> np.ndarray:
    """Rotation vectors ``[..., 3]`` of at most half a turn, of quaternions (w, x, y, z) ``[..., 4]``."""
    q = np.where(quaternion[..., :1] < 0.0, -quaternion, quaternion)
    size = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    half = np.arctan2(size, q[..., :1])
    # 2 half / sin(half), whose limit is 2
    factor = np.where(size > 1e-12, 2.0 * half / np.maximum(size, 1e-300), 2.0)
    return factor * q[..., 1:]


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Products of quaternions (w, x, y, z)."""
    w, v, z, u = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    scalar = w * z - np.sum(v * u, axis=-1, keepdims=True)
    return np.concatenate([scalar, w * u + z * v + np.cross(v, u)], axis=-1)


class Tangent:
    """Sums and differences of states x = (qpos, qvel, act), like ``mj_integratePos`` and ``mj_differentiatePos``.

    A difference is (dq, dv, da): free joints differ by a translation and a rotation vector in the body's frame.

    Args:
        model: The model.
    """

    def __init__(self, model: mujoco.MjModel):
        self.nq, self.nv, self.na = model.nq, model.nv, model.na
        kinds = model.jnt_type
        turning = np.isin(kinds, (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL))
        lead = np.where(kinds == mujoco.mjtJoint.mjJNT_FREE, 3, 0)
        self._quaternion = (model.jnt_qposadr + lead)[turning][:, None] + np.arange(4)
        self._turn = (model.jnt_dofadr + lead)[turning][:, None] + np.arange(3)
        straight = np.ones(model.nv, dtype=bool)
        straight[self._turn.ravel()] = False
        self._straight = np.flatnonzero(straight)
        plain = np.ones(model.nq, dtype=bool)
        plain[self._quaternion.ravel()] = False
        self._plain = np.flatnonzero(plain)

    @property
    def size(self) -> int:
        """Numbers of a difference, n = 2 nv + na."""
        return 2 * self.nv + self.na

    @property
    def width(self) -> int:
        """Numbers of a state, nq + nv + na."""
        return self.nq + self.nv + self.na

    @property
    def rows(self) -> list[tuple[bool, int, int]]:
        """True for a quaternion, its first number in a state, and in a difference, of all that is subtracted."""
        plain = [(False, int(i), int(j)) for i, j in zip(self._plain, self._straight, strict=True)]
        rest = [(False, self.nq + i, self.nv + i) for i in range(self.nv + self.na)]
        turns = zip(self._quaternion[:, 0], self._turn[:, 0], strict=True)
        return [*plain, *((True, int(i), int(j)) for i, j in turns), *rest]

    @property
    def coordinates(self) -> list[tuple[int, int]]:
        """Place in a state of each number of a difference ``[n]``, and the axis that it turns a quaternion about."""
        out = [(0, 0)] * self.size
        for turns, place, first in self.rows:
            for axis in range(3) if turns else [int(STRAIGHT)]:
                out[first + max(axis, 0)] = place, axis
        return out

    def table(self, device: wp.DeviceLike) -> TangentTable:
        """The rows as kernels take them."""
        out = TangentTable()
        out.kind, out.state, out.tangent = (
            wp.array(column, dtype=int, device=device)
            for column in ([turn * int(TURN) for turn, _, _ in self.rows], *list(zip(*self.rows, strict=True))[1:])
        )
        return out

    def add(self, state: np.ndarray, difference: np.ndarray) -> np.ndarray:
        """States ``[..., nq + nv + na]`` moved by differences ``[..., n]``."""
        shape = np.broadcast_shapes(state.shape[:-1], difference.shape[:-1])
        out = np.array(np.broadcast_to(state, (*shape, self.width)))
        dq = difference[..., : self.nv]
        out[..., self._plain] += dq[..., self._straight]
        if len(self._turn):
            turned = _product(out[..., self._quaternion], _rotation(dq[..., self._turn]))
            out[..., self._quaternion] = turned / np.linalg.norm(turned, axis=-1, keepdims=True)
        out[..., self.nq :] += difference[..., self.nv :]
        return out

    def subtract(self, state: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Differences ``[..., n]`` that lead from other states to states."""
        shape = np.broadcast_shapes(state.shape[:-1], other.shape[:-1])
        out = np.empty((*shape, self.size))
        out[..., self._straight] = state[..., self._plain] - other[..., self._plain]
        if len(self._turn):
            back = other[..., self._quaternion] * np.array([1.0, -1.0, -1.0, -1.0])
            out[..., self._turn] = _vector(_product(back, state[..., self._quaternion]))
        out[..., self.nv :] = state[..., self.nq :] - other[..., self.nq :]
        return out


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
