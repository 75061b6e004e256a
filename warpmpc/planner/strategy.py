# SPDX-License-Identifier: Apache-2.0
"""Strategies: how plans are improved. One plan step serves them all."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil
from typing import TYPE_CHECKING, Protocol

import numpy as np
import warp as wp

from ..kernels.planning.weights import forget_cost_kernel
from ..launch import Launcher
from ..scene.errors import SceneError
from ..scene.schema import CovarianceForm, Execute, Method, NoiseShape, Renewal, TryMean
from .covariance import Covariance, control_sigma, covariance_form, per_control
from .distribution import Gaussian
from .fixed_rows import FixedRows
from .moments import SampleMoments
from .noise import NoiseKind, NoiseSource
from .postures import PostureRows
from .rows import BestRows, NullRows, ProposedRows, SequenceRows
from .sequences import sequences
from .shaping import schedule, shaping_matrix
from .weighting import WeightingState, weighting_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..kernels.planning.splines import Spline
    from ..model.layout import Layout
    from ..scene.schema import Planner, Scene
    from ..task.observed import ObservedState


class Strategy(Protocol):
    """Proposes knots, is told what they cost, and knows the plan."""

    population: Sequence[int]
    """How many samples of every environment a round of propose and update tries, one number for each round of a plan;
    the first ones, all others cost +inf then."""
    knots: wp.array4d[float]
    """Proposed knots, ``[E, S, P, nu]``, within the limits."""
    mean: wp.array3d[float]
    """Knots of the plan, ``[E, P, nu]``."""
    offset: wp.array[float]
    """Time from the first knot to the present, ``[E]`` [s]."""
    beta: wp.array[float]
    """Temperature, ``[E]``; one for strategies without."""
    eta: wp.array[float]
    """Number of samples that carry weight, ``[E]``, zero when every sample diverged."""

    def shift(self) -> None:
        """Move the plan on by the time that has passed; capture-safe."""

    def propose(self, iteration: int) -> None:
        """Get ready to sample; capture-safe."""

    def sample(self, iteration: int, first: int, count: int) -> None:
        """Write :attr:`knots` of the samples in rows e·S + s from ``first`` on; capture-safe, on any thread."""

    def update(self, iteration: int) -> None:
        """Learn from the costs of :attr:`knots`; capture-safe."""

    def reset(self, knots: np.ndarray | None = None) -> None:
        """Forget every earlier plan; the next one starts from knots ``[P, nu]`` or ``[E, P, nu]`` if they are given."""


@dataclass(frozen=True)
class Round:
    """What one round of a strategy proposes, as engines take it."""

    strategy: Strategy
    iteration: int

    @property
    def knots(self) -> wp.array:
        """Proposed knots ``[E, S, P, nu]``."""
        return self.strategy.knots

    @property
    def offset(self) -> wp.array:
        """Time from the first knot to the present ``[E]`` [s]."""
        return self.strategy.offset

    @property
    def samples(self) -> int:
        """How many samples of every environment are tried."""
        return self.strategy.population[self.iteration]

    def sample(self, first: int, count: int) -> None:
        """Write the knots of the samples in rows e·S + s from ``first`` on; capture-safe."""
        self.strategy.sample(self.iteration, first, count)


class SamplingStrategy:
    """Samples about a mean, weighs them by cost, moves mean and covariance to the weighted samples.

    MPPI, predictive sampling and the cross-entropy method are its weightings; DIAL-MPC is MPPI with an annealed σ over
    several iterations, STORM is MPPI with a step size, an adapted covariance and its fixed rows, iCEM is the
    cross-entropy method with coloured noise, kept elites and a population that decays.

    Args:
        scene: The scene.
        layout: Its layout.
        state: What plans start from.
        spline: Spline over the knots.
        limits: Lower and upper limits of the controls on the device, ``[nu]`` each.
        cost: Costs of the samples ``[E, S]``, which the engine writes.
        seed: Seed of the noise.

    Raises:
        SceneError: If a list has the wrong number of values, keys contradict each other or sequences do not fit.
    """

    def __init__(
        self,
        scene: Scene,
        layout: Layout,
        state: ObservedState,
        spline: Spline,
        limits: tuple[wp.array, wp.array],
        cost: wp.array,
        *,
        seed: int = 0,
    ):
        planner = self._planner = scene.planner
        device = cost.device
        envs, samples = cost.shape
        count, nu = len(spline.time), layout.nu
        self._state, self._launch = state, Launcher(device)
        self.weighting = weighting_of(planner)
        self.weights = WeightingState(cost, temperature=planner.temperature.initial)
        self.beta, self.eta = self.weights.beta, self.weights.eta
        rest = layout.control_start if len(layout.control_start) else np.zeros(nu, dtype=np.float32)
        form = covariance_form(scene, adapts=self.weighting.adapts_sigma)
        covariance = Covariance(
            form,
            sigma=control_sigma(scene, layout, shared=form is CovarianceForm.SIGMA),
            sigma_min=per_control(planner.sigma_min, layout, scene, "planner.sigma_min"),
            kappa=per_control(planner.covariance.kappa, layout, scene, "planner.covariance.kappa"),
            step_size=planner.covariance.step_size or planner.step_size,
            schedule=schedule(planner.noise, count, planner.iterations),
            envs=envs,
            device=device,
            restarts=planner.covariance.restart,
        )
        self.distribution = Gaussian(state, spline, limits, covariance=covariance, held=layout.control_safe, rest=rest)
        self.offset = self.distribution.offset
        self._best = self._best_rows(scene)
        self._postures = None
        self._fixed = self._fixed_rows(scene, layout, spline, cost, seed)
        self.population = _population(planner, samples, self._fixed.count)
        self.mean = self.distribution.mean if planner.execute is Execute.MEAN else self._best.knots[0]
        self.knots = wp.zeros((envs, samples, count, nu), dtype=float, device=device)
        self.moments = SampleMoments(self.knots, self.weights.weight, full=covariance.full)
        white, redraw = planner.noise.shape is NoiseShape.IDENTITY, planner.noise.redraw
        self.noise = NoiseSource(
            source=NoiseKind(planner.noise.source.value),
            redraw=planner.iterations > 1 or covariance.adapts if redraw is None else redraw,
            seed=seed,
            envs=envs,
            samples=samples,
            knots=count,
            nu=nu,
            spread=planner.noise.spread,
            starts=planner.noise.renewal is Renewal.START,
            shaping=None if white else _shaping(scene, count),
            constant=planner.noise.constant,
            device=device,
        )

    def _best_rows(self, scene: Scene) -> BestRows | None:
        """The best samples so far, if they are tried again or one is carried out."""
        planner = scene.planner
        if planner.keep_best or planner.execute is Execute.BEST:
            return BestRows(self.distribution, int(planner.keep_best))
        return None

    def _fixed_rows(self, scene: Scene, layout: Layout, spline: Spline, cost: wp.array, seed: int) -> FixedRows:
        """The samples that a scene does not want drawn."""
        planner, samples, distribution = scene.planner, cost.shape[1], self.distribution
        nulls = max(int(planner.noise.null_sample), round(planner.noise.null_share * samples))
        rows = [NullRows(nulls, distribution.null)]
        rows += [self._best] if self._best else []
        if planner.postures is not None:
            first = 1 + sum(row.count for row in rows)
            self._postures = PostureRows(
                scene, layout, self._state, spline, distribution.null, cost, first=first, seed=seed
            )
            rows.append(self._postures)
        rows.append(SequenceRows(sequences(scene, spline.time.numpy(), layout.nu)))
        rows.append(ProposedRows(self._state.proposed, distribution.null, len(spline.time) * layout.nu))
        fixed = FixedRows(rows, distribution.dim, distribution.device)
        if fixed.count + 1 > samples:
            kinds = "null, best, postures, sequences, ancillary"
            message = f"the mean and {fixed.count} fixed samples ({kinds}) are more than there are samples"
            raise SceneError(message, key="planner.samples", file=scene.path, found=samples)
        return fixed

    def reset(self, knots: np.ndarray | None = None) -> None:
        """Forget every earlier plan; the next one starts from knots ``[P, nu]`` or ``[E, P, nu]`` if they are given."""
        self.distribution.reset(knots)
        self.weights.reset()
        self.noise.reset()
        if self._postures:
            self._postures.reset()

    def shift(self) -> None:
        """Move mean and covariance on by the time that has passed; capture-safe."""
        self.distribution.shift()
        self._fixed.before_plan()

    def propose(self, iteration: int) -> None:
        """Go on to the next draw of the noise; capture-safe."""
        self.noise.advance(self._state.observed)

    def sample(self, iteration: int, first: int, count: int) -> None:
        """Sample knots about the mean; capture-safe.

        Args:
            iteration: Which round of the plan.
            first: First of the samples' rows e·S + s.
            count: Number of rows.
        """
        if self.noise.redraw:
            self.noise.draw(first, count)
        mean = self._planner.try_mean is TryMean.ALWAYS or iteration == len(self.population) - 1
        self.distribution.perturb(
            self.noise.noise, self._fixed, iteration, mean=mean, knots=self.knots, first=first, count=count
        )

    def update(self, iteration: int) -> None:
        """Weigh the samples, then move the mean, and then the covariance where it is adapted; capture-safe."""
        cost, tried = self.weights.cost, self.population[iteration]
        if tried < cost.shape[1]:
            self._launch(forget_cost_kernel, (cost.shape[0], cost.shape[1] - tried), [tried], [cost])
        self.weighting.launch(self.weights)
        self.distribution.follow(self.moments, iteration, step_size=self._planner.step_size)
        if self._best:
            self.moments.keep_best(cost, self._best.knots)


def _population(planner: Planner, samples: int, fixed: int) -> tuple[int, ...]:
    """Samples that each iteration tries, S/γ^i, but enough for the elites and for those that are not drawn."""
    if planner.method in (Method.GRADIENT_DESCENT, Method.ILQG):
        return ()
    least = max(2 * planner.elites, fixed + 2)
    return tuple(min(samples, max(ceil(samples / planner.decay**i), least)) for i in range(planner.iterations))


def _shaping(scene: Scene, knots: int) -> np.ndarray:
    """The shaping matrix B ``[P, P]`` a scene asks for."""
    try:
        return shaping_matrix(scene.planner.noise, knots)
    except ValueError as error:
        raise SceneError(str(error), key="planner.noise", file=scene.path) from error
