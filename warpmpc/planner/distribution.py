# SPDX-License-Identifier: Apache-2.0
"""The distribution that plans are sampled from: a Gaussian over the knots, shifted through time and updated."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..kernels.planning.sampling import age_plan_kernel, null_control_kernel, perturb_knots_kernel, start_plan_kernel
from ..kernels.planning.splines import LINEAR, Spline, advance_plan_kernel, shift_knots_kernel
from ..kernels.planning.weights import update_mean_kernel, update_sigma_kernel
from ..launch import Launcher
from ..task.observed import ObservedState
from .weighting import BLOCK_DIM


class Gaussian:
    """Mean and standard deviation of every knot of every environment.

    Args:
        state: What plans start from.
        spline: Spline over the knots.
        limits: Lower and upper limits of the controls on the device, ``[nu]`` each.
        sigma: Standard deviation at the start ``[nu]``, in control units.
        held: Joint coordinate that a control holds where it asks for nothing ``[nu]``, -1 for ``rest``.
        rest: Value of a control that asks for nothing ``[nu]``.
    """

    mean: wp.array3d[float]
    """Mean knots, ``[E, P, nu]``, in control units."""
    sigma: wp.array3d[float]
    """Standard deviation of the knots, ``[E, P, nu]``."""
    offset: wp.array[float]
    """Time from the first knot to the present, ``[E]`` [s]; zero but for evenly spaced knots of zero order."""
    null: wp.array2d[float]
    """Controls that ask for nothing in the observed state, ``[E, nu]``."""

    def __init__(
        self,
        state: ObservedState,
        spline: Spline,
        limits: tuple[wp.array, wp.array],
        *,
        sigma: np.ndarray,
        held: np.ndarray,
        rest: np.ndarray,
    ):
        self._state, self._spline, self._limits = state, spline, limits
        self.device = state.joint_q.device
        self._launch = Launcher(self.device)
        envs, knots, nu = len(state.observed), len(spline.time), len(sigma)
        self.dim = (envs, knots, nu)

        def zeros(*dims: int) -> wp.array:
            return wp.zeros(dims, dtype=float, device=self.device)

        self.mean, self.sigma, self._shifted = zeros(*self.dim), zeros(*self.dim), zeros(*self.dim)
        self.offset, self._shift, self.null = zeros(envs), zeros(envs), zeros(envs, nu)
        self._no_shaping = zeros(1, 1)
        self._fresh = wp.zeros(envs, dtype=int, device=self.device)
        self._sigma0 = np.tile(sigma.astype(np.float32), (envs, knots, 1))
        self._held = wp.array(held, dtype=int, device=self.device)
        self._rest = wp.array(rest, dtype=float, device=self.device)
        self.reset()

    def reset(self) -> None:
        """Forget every earlier plan: the next one begins with what is observed then."""
        self.mean.zero_()
        self.sigma.assign(self._sigma0)
        self.offset.zero_()
        self._fresh.fill_(1)

    def shift(self, *, shift_sigma: bool) -> None:
        """Move on by the time that has passed since the last plan; capture-safe.

        Args:
            shift_sigma: Whether σ differs along the horizon and moves with its knots.
        """
        observed, last = self._state.observed, self._state.last_control
        envs, _, nu = self.dim
        limits, by = self._limits, self._shift
        self._launch(
            null_control_kernel, (envs, nu), [self._state.joint_q, self._held, self._rest, *limits], [self.null]
        )
        self._launch(start_plan_kernel, (envs, nu), [observed, self._fresh, self.null], [self.mean, last])
        self._launch(age_plan_kernel, (envs,), [observed], [self._fresh])
        self._launch(advance_plan_kernel, (envs,), [self._spline, self._state.elapsed], [self.offset, by])
        # a cubic through σ would overshoot below zero
        for knots, kind in ((self.mean, self._spline.kind), (self.sigma, int(LINEAR)))[: 1 + shift_sigma]:
            self._launch(shift_knots_kernel, self.dim, [knots, self._spline, kind, by], [self._shifted])
            wp.copy(knots, self._shifted)

    def perturb(
        self,
        z: wp.array,
        shaping: wp.array | None,
        schedule: wp.array,
        iteration: int,
        *,
        null_sample: bool,
        constant: float,
        knots: wp.array,
        first: int,
        count: int,
    ) -> None:
        """Write sampled knots ``[E, S, P, nu]``: the mean, the null sample, and mean + σ ⊙ (B z); capture-safe.

        Args:
            z: Standard normals ``[E, S, P, nu]``.
            shaping: Shaping matrix B ``[P, P]``, None for the identity.
            schedule: Factor on σ ``[n, P]``.
            iteration: Row of the schedule.
            null_sample: Whether the second sample asks for nothing.
            constant: Share of the samples whose noise is the same at every knot.
            knots: Takes the samples.
            first: First of the rows e·S + s to write.
            count: Number of rows.
        """
        matrix = self._no_shaping if shaping is None else shaping
        noise = [self.mean, self.sigma, schedule, iteration, matrix, int(shaping is None), z]
        self._launch(
            perturb_knots_kernel,
            (count, *self.dim[1:]),
            [*noise, *self._limits, self.null, int(null_sample), constant, first],
            [knots],
        )

    def update_mean(self, knots: wp.array, weight: wp.array, alpha: float) -> None:
        """Move the mean towards weighted samples by step size α; capture-safe."""
        self._launch(update_mean_kernel, self.dim, [knots, weight, alpha], [self.mean], block_dim=BLOCK_DIM)

    def update_sigma(self, knots: wp.array, weight: wp.array, floor: wp.array, alpha: float) -> None:
        """Move σ² towards the spread of weighted samples about the mean by step size α; capture-safe."""
        inputs = [knots, weight, self.mean, floor, alpha]
        self._launch(update_sigma_kernel, self.dim, inputs, [self.sigma], block_dim=BLOCK_DIM)
