# SPDX-License-Identifier: Apache-2.0
"""The covariance that samples are drawn with: fixed, or one that follows the samples that carry weight.

Weighted moments of the samples, on any device.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..kernels.planner import covariance as kernels
from ..kernels.planner.covariance import (
    adapt_covariance_kernel,
    adapt_sigma_kernel,
    grow_covariance_kernel,
    grow_sigma_kernel,
)
from ..kernels.planner.moments import (
    keep_best_kernel,
    spread_kernel,
    sweep_mean_kernel,
    sweep_spread_kernel,
    update_mean_kernel,
)
from ..physics.runtime.launch import Launcher
from ..scene.errors import SceneError
from ..scene.schema import CovarianceForm, ShareOfRange
from .weighting import block_dim

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..scene.model.layout import Layout
    from ..scene.schema import Scene


class Covariance:
    """σ of every knot and control, or full covariances of the controls (Bhardwaj et al. 2021, Eq. 5).

    All forms but the full ones live in :attr:`sigma`, where knots that share one σ hold the same number.

    Args:
        sigma: Standard deviation at the start ``[nu]``, in control units.
        sigma_min: Floor of an adapted standard deviation ``[nu]``.
        kappa: Variance that is added when a plan moves on ``[nu]``.
        step_size: Step α_σ towards the spread of the weighted samples, 1 forgets the old value.
        schedule: Factor on the deviation in every iteration at every knot ``[n, P]``.
        restarts: Whether every plan begins with ``sigma`` anew.
    """

    sigma: wp.array3d[float]
    """Standard deviation of the knots ``[E, P, nu]``; that of the start where the covariance is full."""
    covariance: wp.array3d[float]
    """Full covariances of the controls ``[E·n, nu, nu]``, one for all knots or n = P; one zero for the other forms."""
    factor: wp.array3d[float]
    """Their Cholesky factors L ``[E·n, nu, nu]``, lower triangular."""
    bands: wp.array3d[float]
    """Bands of the factor, L[u, u-lag] at every column p·nu + u, ``[E, nu, P·nu]``."""

    def __init__(
        self,
        form: CovarianceForm,
        *,
        sigma: np.ndarray,
        sigma_min: np.ndarray,
        kappa: np.ndarray,
        step_size: float,
        schedule: np.ndarray,
        envs: int,
        device: wp.DeviceLike,
        restarts: bool = False,
    ):
        self.form, self.full = form, form in (CovarianceForm.FULL, CovarianceForm.FULL_KNOTS)
        self.adapts = form is not CovarianceForm.FIXED
        self.varies = form in (CovarianceForm.KNOTS, CovarianceForm.FULL_KNOTS)
        """True where it may differ along the horizon, and moves on with its knots."""
        self._step_size, self._grows, self.device = step_size, bool(np.any(kappa)), wp.get_device(device)
        self._launch = Launcher(self.device)
        self._start = np.asarray(sigma, dtype=np.float32)

        def array(values: np.ndarray) -> wp.array:
            return wp.array(values, dtype=float, device=self.device)

        self._sigma_min, self._kappa, self.schedule = array(sigma_min), array(kappa), array(schedule)
        self.sigma = wp.zeros((envs, schedule.shape[1], len(sigma)), dtype=float, device=self.device)
        nu, knots = len(sigma), schedule.shape[1]
        count = envs * knots if self.varies else envs
        shapes = [(count, nu, nu), (count, nu, nu), (envs, nu, knots * nu)] if self.full else [(1, 1, 1)] * 3
        arrays = (wp.zeros(shape, dtype=float, device=self.device) for shape in shapes)
        self.covariance, self.factor, self.bands = arrays
        self.restarts = restarts
        self.reset()
        adapted = [self.covariance, self.factor, self.bands] if self.full else [self.sigma]
        self._anew = [(array, wp.clone(array)) for array in adapted] if restarts else []

    @property
    def moving(self) -> wp.array3d[float]:
        """Numbers that move on with their knots where it varies, ``[E, P, nu]`` or ``[E, P, nu·nu]``."""
        return self.covariance.reshape((*self.sigma.shape[:2], -1)) if self.full else self.sigma

    def reset(self) -> None:
        """Return to the covariance of the start."""
        self.sigma.assign(np.broadcast_to(self._start, self.sigma.shape).copy())
        if self.full:
            for array, diagonal in ((self.covariance, self._start**2), (self.factor, self._start)):
                array.assign(np.broadcast_to(np.diag(diagonal), array.shape).copy())
            bands = np.zeros(self.bands.shape, dtype=np.float32)
            bands[:, 0] = np.tile(self._start, self.sigma.shape[1])
            self.bands.assign(bands)

    def restart(self) -> None:
        """Return to the covariance of the start in all environments; capture-safe."""
        for array, start in self._anew:
            wp.copy(array, start)

    def grow(self, observed: wp.array, fresh: wp.array) -> None:
        """Add κ to the variance of every environment that is observed and has a plan already; capture-safe.

        What has moved on has its factors anew.
        """
        if not self._grows and not (self.full and self.varies):
            return
        envs, _, nu = self.sigma.shape
        inputs = [observed, fresh, self._kappa]
        if self.full:
            inputs, outputs = [*inputs, self._sigma_min], [self.covariance, self.factor, self.bands]
            self._launch(grow_covariance_kernel, len(self.covariance), inputs, outputs, block_dim=kernels.LANES)
        else:
            self._launch(grow_sigma_kernel, (envs, nu), inputs, [self.sigma])

    def follow(self, moments: SampleMoments, mean: wp.array, iteration: int) -> None:
        """Move towards the spread of the weighted samples about the mean as it is now; capture-safe."""
        if not self.adapts:
            return
        moments.spread_about(mean)
        envs, _, nu = self.sigma.shape
        inputs = [moments.products, moments.total, self.schedule, iteration]
        if self.full:
            inputs, outputs = [*inputs, self._step_size, self._sigma_min], [self.covariance, self.factor, self.bands]
            self._launch(adapt_covariance_kernel, len(self.covariance), inputs, outputs, block_dim=kernels.LANES)
        else:
            inputs += [int(getattr(kernels, self.form.name)), self._step_size, self._sigma_min]
            self._launch(adapt_sigma_kernel, (envs, nu), inputs, [self.sigma])


def covariance_form(scene: Scene, *, adapts: bool) -> CovarianceForm:
    """The form a scene asks for.

    Args:
        adapts: Whether σ of every knot is adapted where the scene does not say.

    Raises:
        SceneError: If other keys contradict it.
    """
    planner, key = scene.planner, "planner.covariance"
    form = planner.covariance.form or (CovarianceForm.KNOTS if adapts else CovarianceForm.FIXED)
    if form is CovarianceForm.FIXED:
        wanted = planner.covariance
        given = {"kappa": any(wanted.kappa), "step_size": wanted.step_size, "restart": wanted.restart}
        for name in given:
            if given[name]:
                allowed = [str(other) for other in CovarianceForm if other is not form]
                message = f"{name} is of an adapted covariance: say which form"
                raise SceneError(message, key=f"{key}.form", file=scene.path, found=str(form), allowed=allowed)
    return form


def control_sigma(scene: Scene, layout: Layout) -> np.ndarray:
    """Standard deviation of the noise ``[nu]``, in control units.

    Raises:
        SceneError: If the scene has neither one value nor one per control.
    """
    key, sigma = "planner.noise.sigma", scene.planner.noise.sigma
    if not isinstance(sigma, ShareOfRange):
        return per_control(sigma, layout, scene, key)
    return per_control(sigma.range, layout, scene, f"{key}.range") * (layout.control_upper - layout.control_lower)


def per_control(values: tuple[float, ...], layout: Layout, scene: Scene, key: str) -> np.ndarray:
    """One value per control from one or ``nu`` values."""
    if len(values) not in (1, layout.nu):
        raise SceneError(
            f"needs 1 or {layout.nu} values, one per control ({', '.join(layout.control_name)})",
            key=key,
            file=scene.path,
            found=list(values),
        )
    return np.broadcast_to(np.array(values, dtype=np.float32), layout.nu).copy()


class SampleMoments:
    """Mean and spread of weighted samples: in blocks on a GPU, in one sweep through memory on the CPU.

    Args:
        knots: Samples ``[E, S, P, nu]``.
        drawn: The same before the limits; without limits when left out.
        weight: Their weights ``[E, S]``.
        limits: Lower and upper limits of the columns, ``[P·nu]`` each; none when left out.
        variance: Relative variance of their noise, 0 where they are not drawn, ``[S]``; 1 when left out.
        full: Whether the spread has products of different controls.
    """

    products: wp.array3d[float]
    """Sums over the samples, Σ w (θ-μ)_c (θ-μ)_{c+lag} of the columns c = p·nu + u, ``[E, lags, P·nu]``."""
    total: wp.array[float]
    """Sums of the weights that belong to them, ``[E]``."""

    def __init__(
        self,
        knots: wp.array,
        weight: wp.array,
        *,
        drawn: wp.array | None = None,
        limits: Sequence[wp.array] = (),
        variance: wp.array | None = None,
        full: bool = False,
    ):
        envs, samples, count, nu = knots.shape
        self.device = knots.device
        self._launch, self._columns, self._block_dim = Launcher(self.device), count * nu, block_dim(samples)
        none = [wp.full(count * nu, bound, dtype=float, device=self.device) for bound in (-wp.inf, wp.inf)]
        self._limits = limits or none
        self._variance = wp.full(samples, 1.0, dtype=float, device=self.device) if variance is None else variance
        self._knots, self._weight = knots.reshape((envs, samples, count * nu)), weight
        self._drawn = self._knots if drawn is None else drawn.reshape(self._knots.shape)
        self._sums = wp.zeros((envs, 3, count * nu), dtype=float, device=self.device)
        self._deviation = wp.zeros((envs, 2, count * nu), dtype=float, device=self.device)
        self.products = wp.zeros((envs, nu if full else 1, count * nu), dtype=float, device=self.device)
        self.total = wp.zeros(envs, dtype=float, device=self.device)

    def _flat(self, plan: wp.array) -> wp.array:
        return plan.reshape((plan.shape[0], self._columns))

    def move_mean(self, mean: wp.array, alpha: float, *, tried: int | None = None) -> None:
        """Move a mean ``[E, P, nu]`` towards the weighted samples by step size α; capture-safe.

        Args:
            tried: Samples that were tried, the first ones; all when left out.
        """
        tried = self._weight.shape[1] if tried is None else tried
        envs, inputs = mean.shape[0], [self._drawn, self._weight, self._variance, tried, *self._limits, alpha]
        if self.device.is_cpu:
            self._launch(sweep_mean_kernel, envs, inputs, [self._sums, self._flat(mean)])
        else:
            outputs = [self._flat(mean)]
            self._launch(update_mean_kernel, (envs, self._columns), inputs, outputs, block_dim=self._block_dim)

    def spread_about(self, mean: wp.array) -> None:
        """Write :attr:`products` and :attr:`total` about a mean ``[E, P, nu]``; capture-safe."""
        inputs, outputs = [self._knots, self._weight, self._flat(mean)], [self.products, self.total]
        if self.device.is_cpu:
            self._launch(sweep_spread_kernel, mean.shape[0], inputs, [self._deviation, *outputs])
        else:
            self._launch(spread_kernel, self.products.shape, inputs, outputs, block_dim=self._block_dim)

    def keep_best(self, cost: wp.array, best: wp.array) -> None:
        """Write the n samples of lowest cost ``[E, S]``, as far as they are finite, into ``best [n, E, P, nu]``.

        Capture-safe.
        """
        inputs, outputs = [cost, self._knots], [best.reshape((*best.shape[:2], self._columns))]
        self._launch(keep_best_kernel, cost.shape[0], inputs, outputs, block_dim=self._block_dim)
