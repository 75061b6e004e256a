# SPDX-License-Identifier: Apache-2.0
"""Knots that move on with time, and the distribution that plans are sampled from: a Gaussian about them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..kernels.planner.proposals import perturb_knots_kernel
from ..kernels.planner.sampling import age_plan_kernel, start_plan_kernel
from ..kernels.planner.splines import LINEAR, Spline, advance_plan_kernel, shift_knots_kernel
from ..physics.runtime.launch import Launcher, step_lanes

if TYPE_CHECKING:
    from ..scene.model.layout import Layout
    from ..scene.task.observed import ObservedState
    from .covariance import Covariance, SampleMoments


def rows(knots: wp.array) -> wp.array:
    """A view of knots ``[..., P, nu]`` as rows ``[..., P·nu]``."""
    return knots.reshape((*knots.shape[:-2], knots.shape[-2] * knots.shape[-1]))


class RecedingPlan:
    """Knots of every environment that move on by the time that passes between plans.

    Args:
        layout: State layout, which says what controls ask for nothing.
        limits: Lower and upper limits of the controls on the device, ``[nu]`` each.
    """

    mean: wp.array3d[float]
    """The knots, ``[E, P, nu]``, in control units."""
    offset: wp.array[float]
    """Time from the first knot to the present, ``[E]`` [s]; zero but for evenly spaced knots of zero order."""
    null: wp.array2d[float]
    """Controls that ask for nothing in the observed state, ``[E, nu]``."""

    def __init__(self, layout: Layout, state: ObservedState, spline: Spline, limits: tuple[wp.array, wp.array]):
        self._state, self._spline, self._limits = state, spline, limits
        self.device = state.joint_q.device
        self._launch = Launcher(self.device)
        envs, nu = len(state.joint_q), layout.nu
        self.dim = envs, len(spline.time), nu

        def zeros(*dims: int) -> wp.array:
            return wp.zeros(dims, dtype=float, device=self.device)

        self.mean, self._shifted = zeros(*self.dim), zeros(*self.dim)
        self._plans = [self.mean]
        self.offset, self._shift, self.null = zeros(envs), zeros(envs), zeros(envs, nu)
        self._fresh = wp.zeros(envs, dtype=int, device=self.device)
        self._held = wp.array(layout.control_safe, dtype=int, device=self.device)
        rest = layout.control_start if len(layout.control_start) else np.zeros(nu)
        self._rest = wp.array(rest, dtype=float, device=self.device)
        self.reset()

    def carry(self, knots: wp.array) -> None:
        """Let other knots ``[E, P, nu]`` start and move on as the mean does."""
        self._plans.append(knots)

    def reset(self, knots: np.ndarray | None = None) -> None:
        """Forget every earlier plan: the next one begins with what is observed then, or with knots that are given.

        Args:
            knots: Mean knots ``[P, nu]``, or ``[E, P, nu]``.
        """
        start = np.zeros(self.dim) if knots is None else np.broadcast_to(knots, self.dim)
        for plan in self._plans:
            plan.assign(start.astype(np.float32))
        self.offset.zero_()
        self._fresh.fill_(knots is None)

    def shift(self) -> None:
        """Move on by the time that has passed since the last plan; capture-safe."""
        observed, last = self._state.observed, self._state.last_control
        envs, _, nu = self.dim
        inputs = [self._state.joint_q, self._held, self._rest, *self._limits]
        for plan in self._plans:
            self._launch(start_plan_kernel, (envs, nu), [observed, self._fresh, *inputs], [self.null, plan, last])
        self._launch(advance_plan_kernel, (envs,), [self._spline, self._state.elapsed], [self.offset, self._shift])
        for plan in self._plans:
            self._move(plan, self._spline.kind)
        self._move_others()
        self._launch(age_plan_kernel, (envs,), [observed], [self._fresh])

    def _move(self, knots: wp.array, kind: int, shifted: wp.array | None = None) -> None:
        """Move knots ``[E, P, nu]`` of a kind of spline; those of another width need their own array for it."""
        shifted = self._shifted if shifted is None else shifted
        self._launch(shift_knots_kernel, knots.shape, [knots, self._spline, kind, self._shift], [shifted])
        wp.copy(knots, shifted)

    def _move_others(self) -> None:
        """Move on what else belongs to the plans."""


class Gaussian(RecedingPlan):
    """Samples about a mean that moves on, and their covariance.

    Args:
        plan: Arguments of :class:`RecedingPlan`.
        covariance: Covariance of the samples.
    """

    def __init__(self, *plan: Any, covariance: Covariance):
        self.covariance = covariance
        super().__init__(*plan)
        self._moved = wp.zeros_like(covariance.moving) if covariance.varies else None
        knots, nu = self.dim[1:]
        self._columns = knots * nu
        self._schedule = wp.array(np.repeat(covariance.schedule.numpy(), nu, axis=1), dtype=float, device=self.device)
        self.column_limits = [wp.zeros(self._columns, dtype=float, device=self.device) for _ in self._limits]
        self.limit()

    def limit(self) -> None:
        """Take the limits of the controls as they are now."""
        for columns, limit in zip(self.column_limits, self._limits, strict=True):
            columns.assign(np.tile(limit.numpy(), self.dim[1]))

    @property
    def sigma(self) -> wp.array3d[float]:
        """Standard deviation of the knots, ``[E, P, nu]``."""
        return self.covariance.sigma

    def reset(self, knots: np.ndarray | None = None) -> None:
        """Forget every earlier plan, as :meth:`RecedingPlan.reset` does, and what the covariance adapted to."""
        super().reset(knots)
        self.covariance.reset()

    def _move_others(self) -> None:
        if self.covariance.restarts:
            self.covariance.restart()
        elif self.covariance.varies:
            self._move(self.covariance.moving, int(LINEAR), self._moved)  # a cubic would overshoot below zero
        self.covariance.grow(self._state.observed, self._fresh)

    def perturb(
        self,
        noise: wp.array,
        undrawn: tuple[wp.array, int],
        iteration: int,
        *,
        mean: bool,
        knots: tuple[wp.array, wp.array],
        first: int,
        count: int,
    ) -> None:
        """Write sampled knots: the mean, what is not drawn, and mean + σ ⊙ (B z); capture-safe.

        Args:
            noise: Shaped noise B z ``[E, S, P, nu]``.
            undrawn: Knots ``[F, E, P, nu]`` of samples that are not drawn, and F, which may be 0.
            iteration: Row of the schedule of σ.
            mean: Whether the mean is among the samples.
            knots: Samples as drawn and within the limits ``[E, S, P, nu]``.
        """
        covariance, lanes = self.covariance, step_lanes(self._columns, self.device)
        spread = [rows(covariance.sigma), covariance.bands, int(covariance.full), self._schedule, iteration]
        others = [rows(undrawn[0]), undrawn[1], int(mean)]
        inputs = [rows(self.mean), *spread, rows(noise), *others, *self.column_limits]
        self._launch(perturb_knots_kernel, (count, lanes), [*inputs, first, lanes], [rows(array) for array in knots])

    def follow(self, moments: SampleMoments, iteration: int, *, tried: int, step_size: float) -> None:
        """Move the mean towards weighted samples, then the covariance towards their spread about it; capture-safe.

        The mean follows the samples as they were drawn, and is put within the limits, which are a part of the model
        (Williams et al. 2018): clipped samples lean away from a near limit, and would move it where all costs are
        equal. The covariance follows the samples as they were rolled out.

        Args:
            moments: Moments of the samples and their weights.
            iteration: Row of the schedule that they were drawn with.
            tried: Samples that were tried, the first ones.
            step_size: Step α_μ of the mean.
        """
        moments.move_mean(self.mean, step_size, tried=tried)
        self.covariance.follow(moments, self.mean, iteration)
