# SPDX-License-Identifier: Apache-2.0
"""First derivatives of physics and residuals along rollouts: every difference is a world that takes one step.

The backward pass of iLQG: feedback policies of quadratic models, with limits of the controls.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ...cost.stack import stage_weights
from ...kernels.planner.derivatives import Moves, difference_kernel, move_kernel
from ...kernels.planner.riccati import backward_kernel, scratch_size
from ...physics.runtime.launch import Launcher, capturing, unrecorded

if TYPE_CHECKING:
    from ...engine.protocol import Engine, EngineRequest, PhysicsSteps
    from ...kernels.planner.costs import CostWeights
    from ...physics.tangent import Tangent
    from .residuals import Residuals

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
        engine: Engine of the plans.
        request: What it was built for.
        steps: Physics steps of the horizon.
        residuals: Residuals of the terms.
        tangent: Tangent space of the model's states.
    """

    def __init__(
        self, engine: Engine, request: EngineRequest, steps: PhysicsSteps, residuals: Residuals, tangent: Tangent
    ):
        layout, device = request.costs.layout, request.device
        self._n, nu = tangent.size, layout.nu
        envs, horizon, rows = request.shape.envs, request.shape.horizon, 1 + self._n + nu
        self.worlds = worlds = engine.step_worlds(request, steps, horizon * (2 * rows - 1), residuals)
        self._launch, self._table = Launcher(device), tangent.table(device)

        def doubles(values: np.ndarray) -> wp.array:
            return wp.array(values, dtype=wp.float64, device=device)

        q, v, u = STEPS
        half = 0.5 * (layout.control_upper.astype(float) - layout.control_lower)
        self._moves = moves = Moves()
        place, axis = zip(*tangent.coordinates, strict=True)
        moves.place, moves.axis = (wp.array(column, dtype=int, device=device) for column in (place, axis))
        moves.state = doubles(np.repeat([q, v, u], [tangent.nv, tangent.nv, tangent.na]))
        moves.control = doubles(u * np.where(np.isfinite(half), half, 1.0))
        moves.lower, moves.upper = doubles(layout.control_lower), doubles(layout.control_upper)
        shapes = (envs, horizon, tangent.width), (envs, horizon, nu), (envs, nu)
        self._nominal = [wp.zeros(shape, dtype=wp.float64, device=device) for shape in shapes]
        shape = envs * horizon, rows, self._n + residuals.width
        self._out = wp.zeros(shape, dtype=wp.float64, device=device)
        self._host = wp.zeros(shape, dtype=wp.float64, device="cpu", pinned=wp.get_device(device).is_cuda)
        count = envs * horizon * rows
        cuts = [count * part // len(worlds.parts) for part in range(len(worlds.parts) + 1)]
        self._rows = [(a, b - a) for a, b in pairwise(cuts)]
        self._forth, self._back = worlds.replays(self._move), worlds.replays(self._compare)

    @unrecorded
    def set_limits(self, lower: np.ndarray, upper: np.ndarray) -> None:
        """Change the limits of the controls ``[nu]``."""
        self._moves.lower.assign(lower)
        self._moves.upper.assign(upper)

    def __call__(self, state: np.ndarray, control: np.ndarray, before: np.ndarray) -> Linear:
        """Differentiate steps from states under controls.

        Args:
            state: States ``[E, T, nx]``.
            control: Controls ``[E, T, nu]``, within their limits.
            before: Controls that acted before the first step ``[E, nu]``.

        Raises:
            FloatingPointError: If the physics of a world failed, or a residual is not finite.
        """
        worlds, n = self.worlds, self._n
        with capturing:
            worlds.follow()  # before the states are written: what is observed would overwrite them
            for array, values in zip(self._nominal, (state, control, before), strict=True):
                array.assign(values)
        worlds.run(self._forth)
        worlds.run(self._back)
        with capturing:
            wp.copy(self._host, self._out)
            wp.synchronize_device(worlds.device)
            out = self._host.numpy().copy()
        if not np.isfinite(out).all():
            raise FloatingPointError("the physics of a perturbed step failed, or a residual of it is not finite")
        out = out.reshape(*control.shape[:2], *out.shape[1:]).swapaxes(2, 3)
        ends, residuals = out[:, :, :n], out[:, :, n:]
        moved, steered = slice(1, 1 + n), slice(1 + n, None)
        return Linear(
            ends[..., moved], ends[..., steered], residuals[..., 0], residuals[..., moved], residuals[..., steered]
        )

    def _move(self, part: int) -> None:
        """Move the states and controls of a part of the worlds and let them take their step."""
        first, count = self.worlds.parts[part]
        outputs = [self.worlds.starts, self.worlds.applied]
        self._launch(move_kernel, count, [first, self._moves, *self._nominal], outputs)
        self.worlds.take(part)

    def _compare(self, part: int) -> None:
        worlds, (first, count) = self.worlds, self._rows[part]
        after = [worlds.ends, worlds.residuals, worlds.diverged, worlds.applied]
        self._launch(difference_kernel, count, [first, self._table, self._moves, *after], [self._out])

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


def gauss_newton(linear: Linear, residuals: Residuals, weights: CostWeights, risk: float) -> Quadratic:
    """Expand γ_t ρ(l_t; R), l = Σ_i w_i n_i(r_i), without second derivatives of the residuals.

    Howell et al. 2022, Eq. 7 and 8.

    Args:
        linear: Residuals and their derivatives.
        residuals: Says how they become costs.
        weights: Factors on what the terms cost.
        risk: R of ρ(l; R).
    """
    envs, steps, width = linear.residual.shape
    value, slope, bend = residuals.norms(linear.residual.reshape(-1, width))
    weight = stage_weights(weights)
    each = weight.repeat(residuals.count, axis=-1)
    slope = each * slope.reshape(envs, steps, width)
    bend = each[..., None] * bend.reshape(envs, steps, width, width)
    c, d = linear.c, linear.d
    x, u = (np.einsum("etr,etrn->etn", slope, j) for j in (c, d))
    xx, ux, uu = (_congruent(p, bend, q) for p, q in ((c, c), (d, c), (d, d)))
    if risk:
        xx, ux, uu = (m + risk * p[..., None] * q[..., None, :] for m, p, q in ((xx, x, x), (ux, u, x), (uu, u, u)))
    stage = np.sum(weight * value.reshape(weight.shape), axis=-1)
    factor = weights.discount.numpy().astype(float) * np.exp(risk * stage)
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


@dataclass(frozen=True)
class Backward:
    """Result of the backward pass."""

    change: np.ndarray
    """k ``[E, T, nu]``."""
    gain: np.ndarray
    """K ``[E, T, nu, n]``; zero for controls at their limits."""
    failed: np.ndarray
    """True where ∂²Q/∂u² is not positive definite with the damping ``[E]``."""


def backward(
    model: Linear, cost: Quadratic, room: tuple[np.ndarray, np.ndarray], scale: np.ndarray, damping: np.ndarray
) -> Backward:
    """Solve the quadratic models of all environments from their ends to their starts.

    Tassa, Erez and Todorov 2012, Eq. 6 to 11, and with limits Tassa, Mansard and Todorov 2014. Controls are taken in
    units of ``scale``, so that one damping suits all of them.

    Args:
        model: Derivatives of the steps.
        cost: Expansion of what they cost.
        room: How far each control may go down and up ``[E, T, nu]`` each.
        scale: Unit of each control ``[nu]``.
        damping: μ of each environment, added to the diagonal of ∂²Q/∂u² ``[E]``.
    """
    given = [model.a, model.b * scale, cost.x, cost.u * scale, cost.xx, cost.ux * scale[:, None]]
    given += [cost.uu * np.outer(scale, scale), *(limit / scale for limit in room), damping]
    envs, steps, n, nu = given[1].shape
    scratch = np.empty((envs, scratch_size(n, nu)))
    out = [np.empty(shape) for shape in ((envs, steps, nu), (envs, steps, nu, n))]
    failed = np.zeros(envs, dtype=np.int32)

    def seen(array: np.ndarray) -> wp.array:
        kind = int if array.dtype == np.int32 else wp.float64
        return wp.array(np.ascontiguousarray(array), dtype=kind, device="cpu", copy=False)

    with capturing:
        outputs = [seen(array) for array in (scratch, *out, failed)]
        wp.launch(backward_kernel, envs, [seen(array) for array in given], outputs, device="cpu")
    change, gain = out
    return Backward(change * scale, gain * scale[:, None], failed != 0)
