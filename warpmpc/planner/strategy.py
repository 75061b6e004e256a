# SPDX-License-Identifier: Apache-2.0
"""Strategies: how plans are improved. One plan step serves them all."""

from __future__ import annotations

import inspect
from functools import partial
from math import ceil
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..engine.protocol import Proposal
from ..kernels.planner.proposals import null_rows_kernel, proposed_rows_kernel
from ..kernels.planner.weights import forget_cost_kernel
from ..physics.runtime.launch import Launcher
from ..scene.errors import SceneError
from ..scene.schema import Execute, NoiseShape, Renewal, TryMean
from ..scene.schema import NoiseSource as NoiseKind
from .covariance import Covariance, SampleMoments, control_sigma, covariance_form, per_control
from .distribution import Gaussian, RecedingPlan
from .noise import NoiseSource, schedule, shaping_matrix
from .proposers import BestSamples, LaunchedSamples, PostureSamples, Proposer, StoredSamples, sequences
from .weighting import Mppi, Weighting, WeightingState

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ..kernels.planner.splines import Spline
    from ..scene.model.layout import Layout
    from ..scene.schema import Planner, Scene
    from ..scene.task.observed import ObservedState


CARRIED_OUT = 0xAC7
"""Separates the stream of samples that are carried out from those that are tried."""


class Strategy:
    """Samples knots, is told what they cost, and knows the plan. One of your own derives from it, or has all it has.

    Args:
        scene: The scene.
        layout: Its layout.
        state: State and task that plans start from, on the device.
        spline: Spline over the knots.
        limits: Lower and upper limits of the controls on the device, ``[nu]`` each.
        cost: Costs of the samples ``[E, S]``, which the engine writes.
        seed: Seed of the noise.
    """

    population: Sequence[int] = ()
    """Samples of every environment that a round of a plan tries, one number for each round;
    the first ones, all others cost +inf then."""
    knots: wp.array4d[float]
    """Sampled knots, ``[E, S, P, nu]``, within the limits."""
    mean: wp.array3d[float]
    """Knots of the plan, ``[E, P, nu]``."""
    offset: wp.array[float]
    """Time from the first knot to the present, ``[E]`` [s]."""
    beta: wp.array[float]
    """Temperature, ``[E]``; one for strategies without."""
    eta: wp.array[float]
    """Number of samples that carry weight, ``[E]``, zero when every sample diverged."""

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
        self._scene, self._planner, self._layout = scene, scene.planner, layout
        self._state, self._spline = state, spline
        self._limits, self._cost, self._seed = limits, cost, seed
        self.knots = wp.zeros((*cost.shape, len(spline.time), layout.nu), dtype=float, device=cost.device)

    def limit(self) -> None:
        """Take the limits of the controls as they are now, where they were copied."""

    def shift(self) -> None:
        """Move the plan on by the time that has passed; capture-safe."""

    def advance(self, iteration: int) -> None:
        """Begin a round, before its samples are written; capture-safe."""

    def sample_knots(self, iteration: int, first: int, count: int) -> None:
        """Write :attr:`knots` of the samples in rows e·S + s from ``first`` on; capture-safe, on any thread."""

    def update(self, iteration: int) -> None:
        """Learn from the costs of :attr:`knots`; capture-safe."""

    def reset(self, knots: np.ndarray | None = None) -> None:
        """Forget every earlier plan; the next one starts from knots ``[P, nu]`` or ``[E, P, nu]`` if they are given."""


STRATEGY = (
    "a strategy is made from (scene, layout, state, spline, limits, cost, *, seed); a class that weighs samples is "
)
STRATEGY += "registered as partial(SamplingStrategy, weighting=Class)"
WEIGHTING = "a weighting has __init__(self, planner), launch(self, state), which fills state.weight and state.eta, and "
WEIGHTING += "adapts_sigma, which is True where the noise follows the weighted samples"


def made(make: Callable, needs: str, names: str, scene: Scene, *given: Any, **more: Any) -> Any:
    """What a registered strategy or weighting makes; an error says what it ``needs`` if ``names`` are missing."""
    try:
        inspect.signature(make).bind(*given, **more)
    except TypeError as error:
        wrong = str(error)
    else:
        out = make(*given, **more)
        wrong = ", ".join(f"no {name}" for name in names.split() if not hasattr(out, name))
        if not wrong:
            return out
    what = f"{getattr(getattr(make, 'func', make), '__name__', make)} cannot be used ({wrong}): {needs}"
    raise SceneError(what, key="planner.method", file=scene.path, found=scene.planner.method)


def proposal(strategy: Strategy, iteration: int) -> Proposal:
    """Proposal of one round of a strategy, as engines take it."""
    write = partial(strategy.sample_knots, iteration)
    return Proposal(strategy.knots, strategy.offset, strategy.population[iteration], write)


class SamplingStrategy(Strategy):
    """Samples about a mean, weighs them by cost, moves mean and covariance to the weighted samples.

    MPPI, predictive sampling and the cross-entropy method are its weightings; DIAL-MPC is MPPI with an annealed σ over
    several iterations, STORM is MPPI with a step size, an adapted covariance and undrawn samples, iCEM is the
    cross-entropy method with coloured noise, kept elites and a population that decays.

    Args:
        plan: Arguments of :class:`Strategy`.
        weighting: Makes the weighting of a scene's planner.
        options: Further arguments of :class:`Strategy`.

    Raises:
        SceneError: If a list has the wrong number of values, keys contradict each other or sequences do not fit.
    """

    def __init__(self, *plan: Any, weighting: Callable[[Planner], Weighting] = Mppi.of, **options: Any):
        super().__init__(*plan, **options)
        scene, layout, planner, cost = self._scene, self._layout, self._planner, self._cost
        envs, samples, count, _ = self.knots.shape
        device = cost.device
        self._launch = Launcher(device)
        self.weighting = made(weighting, WEIGHTING, "launch adapts_sigma", scene, planner)
        self.weights = WeightingState(cost, temperature=planner.temperature.initial)
        self.beta, self.eta = self.weights.beta, self.weights.eta
        form = covariance_form(scene, adapts=self.weighting.adapts_sigma)
        covariance = Covariance(
            form,
            sigma=control_sigma(scene, layout),
            sigma_min=per_control(planner.sigma_min, layout, scene, "planner.sigma_min"),
            kappa=per_control(planner.covariance.kappa, layout, scene, "planner.covariance.kappa"),
            step_size=planner.covariance.step_size or planner.step_size,
            schedule=schedule(planner.noise, count, planner.iterations),
            envs=envs,
            device=device,
            restarts=planner.covariance.restart,
        )
        self.distribution = Gaussian(layout, self._state, self._spline, self._limits, covariance=covariance)
        self.offset = self.distribution.offset
        keeps = planner.keep_best or planner.execute is Execute.BEST
        self._best = BestSamples(self.distribution.carry, int(planner.keep_best)) if keeps else None
        if self._best and not self._best.count:  # the best one is carried out, but not tried again
            self._best.bind(wp.zeros((1, *self.distribution.dim), dtype=float, device=device))
        self.proposers = self._undrawn()
        """Samples that are not drawn, from 1 on; sample 0 is the mean where that is tried."""
        self._fixed = sum(proposer.count for proposer in self.proposers)
        if self._fixed + 1 > samples:
            kinds = "null, best, postures, sequences, ancillary"
            message = f"the mean and {self._fixed} fixed samples ({kinds}) are more than there are samples"
            raise SceneError(message, key="planner.samples", file=scene.path, found=samples)
        self._fixed_knots = wp.zeros((max(self._fixed, 1), *self.distribution.dim), dtype=float, device=device)
        ends = np.cumsum([proposer.count for proposer in self.proposers])
        for proposer, end in zip(self.proposers, ends.tolist(), strict=True):
            proposer.bind(self._fixed_knots[end - proposer.count : end])
        self.population = _population(planner, samples, self._fixed)
        self._drawn: NoiseSource | None = None
        """Noise of the sample that is carried out, where it is drawn for that."""
        self._unlimited = wp.zeros_like(self.knots)
        """The samples before the limits."""
        variance = np.square(np.geomspace(*planner.noise.spread, samples))
        variance[1 : self._fixed + 1] = 0.0
        self.moments = SampleMoments(
            self.knots,
            self.weights.weight,
            drawn=self._unlimited,
            limits=self.distribution.column_limits,
            variance=wp.array(variance, dtype=float, device=device),
            full=covariance.full,
        )
        starts = planner.noise.renewal is Renewal.START
        drawn = {"source": planner.noise.source, "redraw": planner.noise.redraw, "starts": starts}
        self.noise = self._noise_source(**drawn, seed=self._seed, samples=samples, spread=planner.noise.spread)
        self.mean = self.distribution.mean if planner.execute is Execute.MEAN else self._carried_out()

    def _noise_source(self, **own: Any) -> NoiseSource:
        """Noise of the scene's shape for knots, with other settings."""
        envs, _, count, nu = self.knots.shape
        noise, sizes = self._planner.noise, {"envs": envs, "knots": count, "nu": nu}
        shaping = None if noise.shape is NoiseShape.IDENTITY else _shaping(self._scene, count)
        return NoiseSource(**sizes, shaping=shaping, constant=noise.constant, device=self._cost.device, **own)

    def _carried_out(self) -> wp.array:
        """Knots of the plan ``[E, P, nu]`` where it is not the mean: the best sample, or one that is drawn for it."""
        if self._planner.execute is Execute.BEST:
            return self._best.knots[0]
        drawn = {"source": NoiseKind.RANDOM, "redraw": True, "seed": self._seed ^ CARRIED_OUT}
        self._drawn = self._noise_source(**drawn, samples=1)
        return wp.zeros(self.distribution.dim, dtype=float, device=self._cost.device)

    def _draw_plan(self, iteration: int) -> None:
        envs, knots = len(self.mean), self.mean.reshape((len(self.mean), 1, *self.mean.shape[1:]))
        self._drawn.advance(self._state.observed)
        self._drawn.draw(0, envs)
        undrawn, written = (self._fixed_knots, 0), (wp.empty_like(knots), knots)
        self.distribution.perturb(self._drawn.noise, undrawn, iteration, mean=False, knots=written, first=0, count=envs)

    def _undrawn(self) -> list[Proposer]:
        """The samples that a scene does not want drawn."""
        scene, planner, layout, spline = self._scene, self._planner, self._layout, self._spline
        samples, distribution = self._cost.shape[1], self.distribution
        nulls = max(int(planner.noise.null_sample), round(planner.noise.null_share * samples))
        found: list[Proposer] = [LaunchedSamples(nulls, null_rows_kernel, [distribution.null])]
        found += [self._best] if self._best else []
        if planner.postures is not None:
            first = 1 + sum(proposer.count for proposer in found)
            where = {"first": first, "seed": self._seed}
            found.append(PostureSamples(scene, layout, self._state, spline, distribution.null, self._cost, **where))
        found.append(StoredSamples(sequences(scene, spline.time.numpy(), layout.nu)))
        proposed = self._state.proposed
        asked = proposed.shape[1] // (len(spline.time) * layout.nu)
        found.append(LaunchedSamples(asked, proposed_rows_kernel, [proposed, distribution.null]))
        return [proposer for proposer in found if proposer.count]

    def reset(self, knots: np.ndarray | None = None) -> None:
        """Forget every earlier plan; the next one starts from knots ``[P, nu]`` or ``[E, P, nu]`` if they are given."""
        self.distribution.reset(knots)
        self.weights.reset()
        self.noise.reset()
        if self._drawn:
            self._drawn.reset()
        for proposer in self.proposers:
            proposer.reset()

    def limit(self) -> None:
        """Take the limits of the controls as they are now."""
        self.distribution.limit()

    def shift(self) -> None:
        """Move mean and covariance on by the time that has passed; capture-safe."""
        self.distribution.shift()
        for proposer in self.proposers:
            proposer.before_plan()

    def advance(self, iteration: int) -> None:
        """Go on to the next draw of the noise; capture-safe."""
        self.noise.advance(self._state.observed)

    def sample_knots(self, iteration: int, first: int, count: int) -> None:
        """Sample knots about the mean; capture-safe.

        Args:
            first: First of the samples' rows e·S + s.
        """
        if self.noise.redraw:
            self.noise.draw(first, count)
        mean = self._planner.try_mean is TryMean.ALWAYS or iteration == len(self.population) - 1
        undrawn, written = (self._fixed_knots, self._fixed), (self._unlimited, self.knots)
        self.distribution.perturb(
            self.noise.noise, undrawn, iteration, mean=mean, knots=written, first=first, count=count
        )

    def update(self, iteration: int) -> None:
        """Weigh the samples, then move the mean, and then the covariance where it is adapted; capture-safe."""
        cost, tried = self.weights.cost, self.population[iteration]
        if tried < cost.shape[1]:
            self._launch(forget_cost_kernel, (cost.shape[0], cost.shape[1] - tried), [tried], [cost])
        self.weighting.launch(self.weights)
        self.distribution.follow(self.moments, iteration, tried=tried, step_size=self._planner.step_size)
        if self._best:
            self.moments.keep_best(cost, self._best.knots)
        if self._drawn and iteration == len(self.population) - 1:
            self._draw_plan(iteration)


class DerivativeStrategy(Strategy):
    """A plan without samples: derivatives along its own rollout improve it (:mod:`.refine`).

    Gradient descent and iLQG of Howell et al. 2022. Arguments are those of :class:`Strategy`; there is no seed.
    """

    def __init__(self, *plan: Any, **options: Any):
        super().__init__(*plan, **options)
        self._plan, device = RecedingPlan(self._layout, self._state, self._spline, self._limits), self._cost.device
        self.mean, self.offset = self._plan.mean, self._plan.offset
        self.beta = wp.full(len(self.mean), self._planner.temperature.initial, dtype=float, device=device)
        self.eta = wp.zeros(len(self.mean), dtype=float, device=device)

    def shift(self) -> None:
        """Move the plan on by the time that has passed; capture-safe."""
        self._plan.shift()

    def reset(self, knots: np.ndarray | None = None) -> None:
        """Forget every earlier plan; the next one starts from knots ``[P, nu]`` or ``[E, P, nu]`` if they are given."""
        self._plan.reset(knots)
        self.eta.zero_()


def _population(planner: Planner, samples: int, fixed: int) -> tuple[int, ...]:
    """Samples that each iteration tries, S/γ^i, but enough for the elites and for those that are not drawn."""
    least = max(2 * planner.elites, fixed + 2)
    return tuple(min(samples, max(ceil(samples / planner.decay**i), least)) for i in range(planner.iterations))


def _shaping(scene: Scene, knots: int) -> np.ndarray:
    """The shaping matrix B ``[P, P]`` a scene asks for."""
    try:
        return shaping_matrix(scene.planner.noise, knots)
    except ValueError as error:
        raise SceneError(str(error), key="planner.noise", file=scene.path) from error
