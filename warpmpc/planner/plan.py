# SPDX-License-Identifier: Apache-2.0
"""The plan step: clone → sample → spline → roll out → cost → weigh → update → command → shift.

Every strategy (MPPI, predictive sampling, CEM) is this one step with another weighting.
"""

from __future__ import annotations

import time
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..kernels.planning.sampling import perturb_knots_kernel
from ..kernels.planning.splines import command_kernel, shift_knots_kernel, spline_control_kernel
from ..kernels.planning.weights import (
    CVAR,
    MEAN,
    WORST,
    discount_cost_kernel,
    risk_kernel,
    update_mean_kernel,
    update_sigma_kernel,
)
from ..planner import shaping
from ..scene.errors import SceneError
from ..scene.schema import (
    Method,
    Noise,
    NoiseShape,
    Planner,
    Risk,
)
from .noise import NoiseKind, NoiseSource
from .splines import SplineKind
from .weighting import (
    BLOCK_DIM,
    Adaptation,
    CrossEntropy,
    Mppi,
    PredictiveSampling,
    Weighting,
    WeightingState,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from ..cost.stack import CostStack
    from ..engine.trajectory import Engine, ObservedState, Shape
    from ..model.layout import Layout
    from ..scene.schema import Scene

STAGES = ("clone", "sample", "rollout", "cost", "weigh")


class PlanStep:
    """One plan step over all environments, with the state it carries from plan to plan.

    Args:
        scene: The scene.
        layout: Its layout.
        shape: Sizes of the batch.
        engine: Rolls the controls out.
        costs: Judges the rollouts.
        seed: Seed of the noise.
    """

    mean: wp.array3d[float]
    """Mean knots, ``[E, P, nu]``, in control units."""
    sigma: wp.array3d[float]
    """Standard deviation of the knots, ``[E, P, nu]``."""
    control: wp.array3d[float]
    """Sampled controls, ``[T, W, nu]``."""
    command: wp.array2d[float]
    """Control to apply now, ``[E, nu]``."""

    def __init__(self, scene: Scene, layout: Layout, shape: Shape, engine: Engine, costs: CostStack, *, seed: int = 0):
        planner = scene.planner
        self.planner, self.layout, self.shape, self.engine, self.costs = planner, layout, shape, engine, costs
        self.device = engine.device
        envs, samples, nu = shape.envs, shape.samples, layout.nu
        self.knots_count = planner.knots or shape.horizon
        self.control_dt, self.step_dt = scene.timing.control_dt, step_dt(scene)
        # P = T: one knot per step; fewer knots span the horizon end to end
        span = shape.horizon if self.knots_count == shape.horizon else shape.horizon - 1
        steps = self.knots_count if self.knots_count == shape.horizon else self.knots_count - 1
        self.knot_dt = self.step_dt * span / steps
        self.kind = SplineKind(planner.spline.value).code

        def array(values: np.ndarray) -> wp.array:
            return wp.array(values, dtype=float, device=self.device)

        def empty(*dims: int) -> wp.array:
            return wp.zeros(dims, dtype=float, device=self.device)

        self.lower, self.upper = array(layout.control_lower), array(layout.control_upper)
        self._sigma0 = np.tile(
            _per_control(planner.noise.sigma, layout, scene, "planner.noise.sigma"), (envs, self.knots_count, 1)
        )
        floor = _per_control(planner.sigma_min, layout, scene, "planner.sigma_min")
        self.sigma_min = array(floor)
        self.start = np.zeros(nu, dtype=np.float32)
        held = layout.control_safe >= 0
        self.start[held] = layout.joint_q[layout.control_safe[held]]
        self.start = np.clip(self.start, layout.control_lower, layout.control_upper)
        self.mean, self.sigma = empty(envs, self.knots_count, nu), empty(envs, self.knots_count, nu)
        self._shifted = empty(envs, self.knots_count, nu)
        self.knots = empty(envs, samples, self.knots_count, nu)
        self.control = empty(shape.horizon, shape.worlds, nu)
        self.rollout_cost = empty(shape.worlds)
        self.command = empty(envs, nu)
        self.weighting = weighting_of(planner)
        self.noise = NoiseSource(
            source=NoiseKind(planner.noise.source.value),
            # a σ that narrows onto the same draws again and again carries the plan away from the optimum
            redraw=planner.noise.redraw or planner.iterations > 1 or self.weighting.adapts_sigma,
            seed=seed,
            envs=envs,
            samples=samples,
            knots=self.knots_count,
            nu=nu,
            spread=planner.noise.spread,
            device=self.device,
        )
        self.shaping = array(shaping_matrix(planner.noise, self.knots_count))
        self.weights = WeightingState(
            envs=envs, samples=samples, temperature=planner.temperature.initial, device=self.device
        )
        self._risk = {Risk.MEAN: MEAN, Risk.WORST: WORST, Risk.CVAR: CVAR}[planner.risk]
        self.stages = dict.fromkeys(STAGES, 0.0)
        costs.attach(engine.trajectory, self.control, shape)
        self.reset()

    def reset(self) -> None:
        """Forget every earlier plan."""
        self.mean.assign(np.broadcast_to(self.start, self.mean.shape).copy())
        self.sigma.assign(self._sigma0)
        self.weights.reset()
        self.noise.reset()
        self.costs.reset()
        self.costs.last_control.assign(np.broadcast_to(self.start, self.command.shape).copy())

    def __call__(self, state: ObservedState) -> None:
        """Plan from the observed state; the result is in :attr:`command`. Capture-safe where the engine is."""
        self.stages = dict.fromkeys(STAGES, 0.0)
        for stage, run in self.sequence(state):
            with self._stage(stage):
                run()

    def sequence(self, state: ObservedState) -> list[tuple[str, Callable[[], None]]]:
        """The plan step in order, each piece with the stage it belongs to."""
        iteration = [
            ("sample", self._sample),
            ("rollout", lambda: self.engine.rollout(self.control)),
            ("cost", self._judge),
            ("weigh", self._weigh),
        ]
        return [
            ("clone", lambda: self.engine.clone(state)),
            ("cost", self.costs.guide),
            *(iteration * self.planner.iterations),
            ("weigh", self._finish),
        ]

    @contextmanager
    def _stage(self, name: str) -> Iterator[None]:
        """Add the wall time [s] of a stage to :attr:`stages`."""
        start = time.perf_counter()
        yield
        self.stages[name] += time.perf_counter() - start

    def _launch(self, kernel: wp.Kernel, dim: tuple[int, ...], inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)

    def _sample(self) -> None:
        self.noise.launch()
        self._launch(
            perturb_knots_kernel,
            self.knots.shape,
            [
                self.mean,
                self.sigma,
                self.shaping,
                self.noise.z,
                self.lower,
                self.upper,
                int(self.planner.noise.null_sample),
                self.planner.noise.constant,
            ],
            [self.knots],
        )
        self._launch(
            spline_control_kernel,
            self.control.shape[:2],
            [self.knots, self.lower, self.upper, self.kind, self.knot_dt, self.step_dt, self.shape.domains],
            [self.control],
        )

    def _judge(self) -> None:
        """Stage costs of all terms, then one cost per sample."""
        self.costs.launch()
        self._launch(
            discount_cost_kernel,
            (self.shape.worlds,),
            [self.costs.cost, self.engine.trajectory.diverged, self.planner.discount],
            [self.rollout_cost],
        )
        self._launch(
            risk_kernel,
            self.weights.cost.shape,
            [self.rollout_cost, self.shape.domains, self._risk, self.planner.cvar],
            [self.weights.cost],
        )

    def _weigh(self) -> None:
        """Weights of the samples, then the new mean and σ."""
        self.weighting.launch(self.weights)
        envs, _, knots, nu = self.knots.shape
        wp.launch_tiled(
            update_mean_kernel,
            dim=[envs, knots, nu],
            inputs=[self.knots, self.weights.weight, self.planner.step_size],
            outputs=[self.mean],
            block_dim=BLOCK_DIM,
            device=self.device,
        )
        if self.weighting.adapts_sigma:
            wp.launch_tiled(
                update_sigma_kernel,
                dim=[envs, knots, nu],
                inputs=[self.knots, self.weights.weight, self.mean, self.sigma_min, self.weighting.alpha_sigma],
                outputs=[self.sigma],
                block_dim=BLOCK_DIM,
                device=self.device,
            )

    def _finish(self) -> None:
        """Write the command, then move the plan one control ahead."""
        self._launch(
            command_kernel,
            self.command.shape,
            [self.mean, self.lower, self.upper, self.kind, 0.0, self.knot_dt],
            [self.command],
        )
        wp.copy(self.costs.last_control, self.command)
        for plan in (self.mean, self.sigma) if self.weighting.adapts_sigma else (self.mean,):
            self._launch(
                shift_knots_kernel, plan.shape, [plan, self.kind, self.control_dt, self.knot_dt], [self._shifted]
            )
            wp.copy(plan, self._shifted)


def step_dt(scene: Scene) -> float:
    """Length of one step of a scene's rollouts [s].

    Raises:
        SceneError: If it differs from the control's and the spline is of zero order, which could not be moved ahead
            by part of a step.
    """
    dt = scene.planner.dt or scene.timing.control_dt
    if abs(dt - scene.timing.control_dt) > 1e-9 and scene.planner.spline == SplineKind.ZERO:
        raise SceneError(
            "rollout steps that differ from timing.control_dt need a smoother spline",
            key="planner.spline",
            file=scene.path,
            found="zero",
            allowed="linear, cubic, bspline",
        )
    return dt


def weighting_of(planner: Planner) -> Weighting:
    """The weighting a scene asks for."""
    match planner.method:
        case Method.MPPI:
            t = planner.temperature
            adapt = Adaptation.ESS if t.ess else Adaptation.ETA if t.eta else Adaptation.FIXED
            return Mppi(temperature=t.initial, adapt=adapt, eta=t.eta or (5.0, 10.0), target_ess=t.ess or 10.0)
        case Method.PREDICTIVE_SAMPLING:
            return PredictiveSampling()
        case Method.CEM:
            return CrossEntropy(elites=planner.elites, alpha_sigma=planner.step_size)


def shaping_matrix(noise: Noise, knots: int) -> np.ndarray:
    """The shaping matrix B ``[P, P]`` a scene asks for."""
    match noise.shape:
        case NoiseShape.IDENTITY:
            return shaping.identity(knots)
        case NoiseShape.BSPLINE:
            return shaping.bspline(knots)
        case NoiseShape.COMB:
            return shaping.comb(knots, *noise.comb)
        case NoiseShape.COLOURED:
            return shaping.coloured(knots, noise.exponent)


def _per_control(values: tuple[float, ...], layout: Layout, scene: Scene, key: str) -> np.ndarray:
    """One value per control from one or ``nu`` values."""
    if len(values) not in (1, layout.nu):
        raise SceneError(
            f"needs 1 or {layout.nu} values, one per control ({', '.join(layout.control_name)})",
            key=key,
            file=scene.path,
            found=list(values),
        )
    return np.broadcast_to(np.array(values, dtype=np.float32), layout.nu).copy()
