# SPDX-License-Identifier: Apache-2.0
"""First derivatives of physics and residuals along rollouts: every difference is a world that takes one step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .kinds import step_worlds

if TYPE_CHECKING:
    from ..engine.registry import EngineRequest, PhysicsSteps
    from .residuals import Residuals
    from .tangent import Tangent

STEPS = (1e-4, 1e-3, 1e-3)
"""Steps of the differences in coordinates [m or rad], velocities [m/s or rad/s] and controls (and activations), these
as a share of half their range. Residuals are in single precision, and so is the physics of ``fused``: numbers near 1
are 1e-7 apart there, and smaller steps would lose more than a thousandth; larger ones would make and break contacts,
which are a millimetre deep or less. What is of third order in the steps is lost; forces that are quadratic in
velocities lose nothing."""


@dataclass(frozen=True)
class Linear:
    """Derivatives of one control step at every step of some rollouts, in the tangent space of the states.

    Residuals are those after the step, as functions of state and control before it.
    """

    a: np.ndarray
    """∂x'/∂x ``[E, T, n, n]``."""
    b: np.ndarray
    """∂x'/∂u ``[E, T, n, nu]``."""
    residual: np.ndarray
    """``[E, T, R]``."""
    c: np.ndarray
    """∂r/∂x ``[E, T, R, n]``."""
    d: np.ndarray
    """∂r/∂u ``[E, T, R, nu]``."""


class Differences:
    """Centred differences at all steps of a horizon at once, in E·T·(1 + 2(n + nu)) worlds.

    Args:
        name: Engine of the worlds.
        request: What the plans' engine was built for.
        steps: Physics steps of the horizon.
        residuals: Residuals of the terms.
        tangent: Tangent space of the model's states.
    """

    def __init__(self, name: str, request: EngineRequest, steps: PhysicsSteps, residuals: Residuals, tangent: Tangent):
        layout, self.tangent = request.costs.layout, tangent
        self._n, nu = tangent.size, layout.nu
        shape = request.shape.envs, request.shape.horizon, 1 + 2 * (self._n + nu)
        self.worlds = step_worlds(name, request, steps, shape[1] * shape[2], residuals)
        self._shape = shape
        self._lower, self._upper = layout.control_lower.astype(float), layout.control_upper.astype(float)
        q, v, u = STEPS
        half = 0.5 * (self._upper - self._lower)
        self._control_step = u * np.where(np.isfinite(half), half, 1.0)
        t = tangent
        self._moves = np.diag(np.repeat([q, v, u], [t.nv, t.nv, t.na]))
        """Steps of the state, one to a row ``[n, n]``."""

    def set_limits(self, lower: np.ndarray, upper: np.ndarray) -> None:
        """Change the limits of the controls ``[nu]``."""
        self._lower, self._upper = lower, upper

    def __call__(self, state: np.ndarray, control: np.ndarray, before: np.ndarray) -> Linear:
        """Differentiate steps from states under controls.

        Args:
            state: States ``[E, T, nx]``.
            control: Controls ``[E, T, nu]``, within their limits.
            before: Controls that acted before the first step ``[E, nu]``.

        Raises:
            FloatingPointError: If the physics of a world failed, or a residual is not finite.
        """
        worlds, tangent, n, nu = self.worlds, self.tangent, self._n, control.shape[-1]
        worlds.follow()  # before the states are written: what is observed would overwrite them
        start = worlds.start.reshape(*self._shape, -1)
        controls = worlds.control.reshape(*self._shape, nu)
        start[:] = state[:, :, None]
        start[:, :, 1 : 1 + n] = tangent.add(state[:, :, None], self._moves)
        start[:, :, 1 + n : 1 + 2 * n] = tangent.add(state[:, :, None], -self._moves)
        controls[:] = control[:, :, None]
        # at a limit the difference is taken on its inside; engines take controls in single precision
        up = np.minimum(control + self._control_step, self._upper).astype(np.float32).astype(float)
        down = np.maximum(control - self._control_step, self._lower).astype(np.float32).astype(float)
        each = np.arange(nu)
        controls[:, :, 1 + 2 * n + each, each] = up
        controls[:, :, 1 + 2 * n + nu + each, each] = down
        earlier = np.concatenate([before[:, None], control[:, :-1]], axis=1)
        worlds.before.reshape(controls.shape)[:] = earlier[:, :, None]
        worlds.step()
        end, residual = worlds.end.reshape(*self._shape, -1), worlds.residual.reshape(*self._shape, -1).astype(float)
        if not (np.isfinite(end).all() and np.isfinite(residual).all()):
            raise FloatingPointError("the physics of a perturbed step failed, or a residual of it is not finite")
        spread = 2.0 * np.diag(self._moves)
        wide = (up - down)[..., None]
        states, controlled = slice(1, 1 + n), slice(1 + 2 * n, 1 + 2 * n + nu)
        back, other = slice(1 + n, 1 + 2 * n), slice(1 + 2 * n + nu, None)
        a = tangent.subtract(end[:, :, states], end[:, :, back]) / spread[:, None]
        b = tangent.subtract(end[:, :, controlled], end[:, :, other]) / wide
        c = (residual[:, :, states] - residual[:, :, back]) / spread[:, None]
        d = (residual[:, :, controlled] - residual[:, :, other]) / wide
        return Linear(
            *(x.swapaxes(2, 3) for x in (a, b)), residual[:, :, 0].copy(), *(x.swapaxes(2, 3) for x in (c, d))
        )

    def close(self) -> None:
        """Stop the threads."""
        self.worlds.close()


@dataclass(frozen=True)
class Quadratic:
    """Second-order expansion of what every step costs, in its state and control."""

    x: np.ndarray
    """∂c/∂x ``[E, T, n]``."""
    u: np.ndarray
    """∂c/∂u ``[E, T, nu]``."""
    xx: np.ndarray
    """``[E, T, n, n]``."""
    ux: np.ndarray
    """``[E, T, nu, n]``."""
    uu: np.ndarray
    """``[E, T, nu, nu]``."""


def gauss_newton(
    linear: Linear, residuals: Residuals, weight: np.ndarray, discount: np.ndarray, risk: float
) -> Quadratic:
    """Expand γ_t ρ(l_t; R), l = Σ_i w_i n_i(r_i), without second derivatives of the residuals.

    Howell et al. 2022, Eq. 7 and 8.

    Args:
        linear: Residuals and their derivatives.
        residuals: Says how they become costs.
        weight: Weight of each term at every step ``[E, T, term]``.
        discount: γ_t ``[T]``.
        risk: R of ρ(l; R).
    """
    envs, steps, width = linear.residual.shape
    value, slope, bend = residuals.norms(linear.residual.reshape(-1, width))
    each = weight.repeat(residuals.count, axis=-1)
    slope = each * slope.reshape(envs, steps, width)
    bend = each[..., None] * bend.reshape(envs, steps, width, width)
    c, d = linear.c, linear.d
    x, u = (np.einsum("etr,etrn->etn", slope, j) for j in (c, d))
    xx, ux, uu = (_congruent(p, bend, q) for p, q in ((c, c), (d, c), (d, d)))
    if risk:
        xx, ux, uu = (m + risk * p[..., None] * q[..., None, :] for m, p, q in ((xx, x, x), (ux, u, x), (uu, u, u)))
    stage = np.sum(weight * value.reshape(weight.shape), axis=-1)
    factor = discount * np.exp(risk * stage)
    return Quadratic(*(factor.reshape(envs, steps, *(1,) * (m.ndim - 2)) * m for m in (x, u, xx, ux, uu)))


def held(linear: Linear, cost: Quadratic, hold: int) -> tuple[Linear, Quadratic]:
    """Several steps under one control as one step: what its state and control do to the next one, and all they cost.

    The last of these may have fewer steps than the others. Residuals are left out.

    Args:
        linear: Derivatives of the steps.
        cost: Expansion of what they cost.
        hold: Steps that a control is held for.
    """
    if hold == 1:
        return linear, cost
    (envs, steps, n, nu), count = linear.b.shape, -(-linear.b.shape[1] // hold)
    a, b = np.tile(np.eye(n), (envs, count, 1, 1)), np.zeros((envs, count, n, nu))
    x, u = np.zeros((envs, count, n)), np.zeros((envs, count, nu))
    xx, ux, uu = (np.zeros((envs, count, *shape)) for shape in ((n, n), (nu, n), (nu, nu)))
    for j in range(hold):
        at, some = slice(j, None, hold), slice(0, len(range(j, steps, hold)))
        moved, driven = a[:, some], b[:, some]  # of the state that this step begins in
        slope, mixed = cost.x[:, at], cost.ux[:, at]
        x[:, some] += np.einsum("etji,etj->eti", moved, slope)
        u[:, some] += cost.u[:, at] + np.einsum("etji,etj->eti", driven, slope)
        cross = mixed @ driven
        xx[:, some] += _congruent(moved, cost.xx[:, at], moved)
        ux[:, some] += _congruent(driven, cost.xx[:, at], moved) + mixed @ moved
        uu[:, some] += _congruent(driven, cost.xx[:, at], driven) + cross + cross.swapaxes(-1, -2) + cost.uu[:, at]
        a[:, some], b[:, some] = linear.a[:, at] @ moved, linear.a[:, at] @ driven + linear.b[:, at]
    none = np.zeros((envs, count, 0))
    return Linear(a, b, none, none, none), Quadratic(x, u, xx, ux, uu)


def _congruent(left: np.ndarray, middle: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Lᵀ M R of every step."""
    return left.swapaxes(-1, -2) @ (middle @ right)
