# SPDX-License-Identifier: Apache-2.0
"""Which derivatives stand behind the samples, and iLQG behind samples whose plans have fewer knots and other steps."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..engine.protocol import PhysicsSteps, TimeGrid
from ..engine.registry import physics_steps
from ..physics.runtime.launch import unrecorded
from ..scene.errors import SceneError
from ..scene.model.trajectory import BatchSize
from ..scene.schema import Execute, Refinement, SplineKind
from .derivatives.residuals import Residuals
from .refine import DRAWS, GradientRefiner, IlqgRefiner, refined
from .splines import spline_table, spline_value
from .strategy import SamplingStrategy

if TYPE_CHECKING:
    from ..engine.protocol import Engine, EngineRequest
    from ..kernels.planner.splines import Spline
    from ..scene.schema import Scene
    from .refine import Refiner
    from .strategy import Strategy


def fine_grid(grid: TimeGrid, control_dt: float) -> TimeGrid:
    """As far as a time grid, in steps of a control or shorter; the last step counts as much beside all others.

    Args:
        grid: Steps of the samples' rollouts.
        control_dt: Length of a control [s].
    """
    step = min(float(grid.dt[0]), control_dt)
    count = max(round(float(grid.t[-1]) / step), 1)
    at = np.searchsorted(grid.t[1:-1], step * np.arange(count) + 1e-9, side="right")
    discount = grid.discount[np.minimum(at, grid.steps - 1)].copy()
    if grid.steps > 1:
        discount[at == grid.steps - 1] = grid.discount[-2]
    discount[-1] = grid.discount[-1] * count / grid.steps
    return TimeGrid(np.full(count, step), discount)


def most_knots(scene: Scene) -> int:
    """Most knots that a plan of a scene has."""
    planner, grid = scene.planner, TimeGrid.of(scene)
    steps = fine_grid(grid, scene.timing.control_dt).steps if planner.finishes else grid.steps
    return max(planner.knot_count or 0, steps)


@dataclass(frozen=True)
class PlanSpline:
    """Spline of the plans that are handed out."""

    kind: SplineKind
    times: np.ndarray
    """Times of the knots after the first ``[P]`` [s]."""

    def table(self, step: float, device: str) -> Spline:
        """As kernels take it."""
        return spline_table(self.kind, self.times, step, device)


class SampledIlqg(IlqgRefiner):
    """iLQG in steps of a control, from the samples' plan, their best and its own last plan; the cheapest is improved.

    The samples keep their steps and knots. The plan that is handed out is iLQG's, a control for each of its steps;
    samples are drawn about the knots that come nearest to it. Where terms watch contacts, candidates are tried in
    several worlds under some of the samples' noise: what is best without it passes obstacles as close as it can.
    """

    def __init__(self, engine: Engine, request: EngineRequest, steps: PhysicsSteps, strategy: SamplingStrategy):
        scene, envs = request.scene, request.shape.envs
        self.noisy = bool(request.costs.pairs)
        self._kind, self._sampled = scene.planner.spline, request.spline.time.numpy().astype(float)
        grid = fine_grid(request.grid, scene.timing.control_dt)
        shape = BatchSize(envs, 1, 1, grid.steps)
        fine = replace(request, grid=grid, shape=shape)
        count = max(round(float(grid.dt[0]) / steps.length[0]), 1)
        steps = PhysicsSteps((count,) * grid.steps, tuple((grid.dt / count).tolist()))
        super().__init__(engine, fine, steps, strategy)
        held = grid.t[: -1 : self.hold]
        self.plan = PlanSpline(SplineKind.ZERO, held)
        self.knots = wp.zeros((envs, len(held), request.costs.layout.nu), dtype=float, device=request.device)
        """Knots of the plan ``[E, T/hold, nu]``."""
        self.offset = wp.zeros(envs, dtype=float, device=request.device)
        self.spline = self.plan.table(float(grid.dt[0]), request.device)
        self._matrices: dict[float, tuple[np.ndarray, np.ndarray]] = {}

    def _check_knots(self) -> None:
        """Any knots will do."""

    def __call__(self) -> None:
        """Improve the cheapest of the plans; where that fails the samples' plan is handed out, and why is logged."""
        self._alike = [self._matrix(float(offset)) for offset in self._strategy.offset.numpy()]
        if self.noisy:
            self._noise = NOISE * self._sampled_noise()[:, None]
        super().__call__()

    @unrecorded
    def _sampled_noise(self) -> np.ndarray:
        """Noise of the draws ``[E, D, T, nu]``: none in the first, in others (a - b) / √2 of two samples a and b."""
        knots, last = self._strategy.knots.numpy(), np.arange(2 - 2 * DRAWS, 0)
        knots = knots[:, last % knots.shape[1]].astype(float)
        pairs = (knots[:, ::2] - knots[:, 1::2]) / np.sqrt(2.0)
        control = np.einsum("etp,edpu->edtu", np.stack([blend for blend, _ in self._alike]), pairs)
        return np.concatenate([np.zeros_like(control[:, :1]), control], axis=1)

    @unrecorded
    def _conclude(self) -> None:
        if self.feedback is None:
            self.knots.assign(self._held_controls(self._strategy.mean.numpy())[:, :: self.hold].astype(np.float32))

    def _matrix(self, offset: float) -> tuple[np.ndarray, np.ndarray]:
        """Shares of each knot in each control ``[T, P]`` so long after the first knot [s], and its pseudoinverse."""
        key = round(offset, 6)
        if key not in self._matrices:
            if len(self._matrices) > 64:
                self._matrices.clear()
            unit, times = np.eye(len(self._sampled)), self._request.grid.t[:-1]
            blend = np.stack([spline_value(self._kind, self._sampled, unit, float(t + offset)) for t in times])
            self._matrices[key] = blend, np.linalg.pinv(blend)
        return self._matrices[key]

    def _held_controls(self, knots: np.ndarray) -> np.ndarray:
        """Controls ``[E, T, nu]`` of knots ``[E, P, nu]``, within the limits."""
        control = np.stack([blend @ own for (blend, _), own in zip(self._alike, knots.astype(float), strict=True)])
        control = np.clip(control, self._lower, self._upper)
        return control[:, :: self.hold].repeat(self.hold, axis=1)[:, : control.shape[1]]

    @unrecorded
    def _starts(self) -> list[np.ndarray]:
        strategy = self._strategy
        best = np.argmin(self._engine.cost.numpy(), axis=1)
        knots = np.stack([strategy.knots[e, int(i)].numpy() for e, i in enumerate(best)])
        return [self._held_controls(x) for x in (strategy.mean.numpy(), knots)]

    @unrecorded
    def _take(self, control: np.ndarray) -> None:
        self.knots.assign(control.astype(np.float32))
        control = control.repeat(self.hold, axis=1)[:, : self._request.grid.steps]
        mean = self._strategy.mean.numpy().astype(float)
        away = control - np.stack([blend @ own for (blend, _), own in zip(self._alike, mean, strict=True)])
        mean += np.stack([back @ own for (_, back), own in zip(self._alike, away, strict=True)])
        self._strategy.mean.assign(np.clip(mean, self._lower, self._upper).astype(np.float32))


NOISE = 0.1
"""Noise under which candidates are tried where terms watch contacts, as a share of the samples'. Without it a robot
that keeps away from a post with samples touched it in 9 of 12 runs, since derivatives see a force only once there is
contact; with .1 of it in 0 of 16. Elsewhere it costs: a load that hangs from a drone came to rest in 7 of 10 runs
with .1, in none with .3, in all without."""
MOST = 0.5
"""Most worlds that differences take under ``auto``, as a share of those that the samples take in all rounds: plans take
about twice as long then, on one core. With more, the plans of a humanoid took five times as long and were no better."""


def suits(request: EngineRequest, engine: Engine, physics: bool) -> bool:
    """True where iLQG goes on from samples unasked: it is cheap beside them, and plans may be unstable.

    On a GPU it takes three to eight times as long as the samples, whose plan is a single graph.
    """
    planner, layout = request.scene.planner, request.costs.layout
    worlds = 1 + 2 * (2 * layout.nv + layout.na + layout.nu)
    samples = request.shape.rollouts * planner.iterations
    on_cpu = not wp.get_device(request.device).is_cuda
    smooth = Residuals.refusal(request.costs) is None
    at_hand = on_cpu and physics and smooth and hasattr(engine, "step_worlds")
    return at_hand and planner.execute is Execute.MEAN and worlds <= MOST * samples


def refiner_of(
    name: str, request: EngineRequest, engine: Engine, strategy: Strategy, *, physics: bool
) -> Refiner | None:
    """Refiner that a scene asks for, None without.

    Args:
        name: Name of the engine.
        request: What it was built for.
        engine: The engine.
        strategy: What proposes the plans.
        physics: Whether the engine's worlds have physics.

    Raises:
        SceneError: If the engine has no derivatives, or the scene does not allow them.
    """
    scene = request.scene
    method = refined(scene)
    if method is None:
        return None
    if method is Refinement.AUTO and not (isinstance(strategy, SamplingStrategy) and suits(request, engine, physics)):
        return None
    if not hasattr(engine, "step_worlds"):
        raise SceneError(
            f"no derivatives of the engine {name}: its class {type(engine).__name__} has no step_worlds (as "
            "SimulatorEngine has); take another engine or a planner without derivatives",
            key="engine.name",
            file=scene.path,
            found=name,
        )
    steps = physics_steps(name, scene, request.compiled, request.grid)
    make = GradientRefiner if method is Refinement.GRADIENT else SampledIlqg if scene.planner.finishes else IlqgRefiner
    return make(engine, request, steps, strategy)
