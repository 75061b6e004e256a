# SPDX-License-Identifier: Apache-2.0
"""The plan step: begin (shift) → n × (sample → evaluate → update) → command. Every strategy is this one step.

The strategies by name.

A whole plan as one step from host to host: one copy in, one copy out, on CUDA a single captured graph between.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..engine.protocol import TimeGrid
from ..engine.registry import EngineRequest, make_engine
from ..kernels.engine.packing import REPORT, report_kernel, survey_kernel, unpack_kernel
from ..kernels.planner.splines import command_kernel
from ..physics.runtime.launch import CapturedLaunches, Launcher, step_lanes
from ..scene.registry import STRATEGIES
from ..scene.schema import Method, Refinement
from ..scene.task.observed import ObservedState
from .ancillary import Ancillaries
from .plan import Plan, PlanReport, refitted
from .refine import control_hold, refined
from .refiners import PlanSpline, SampledIlqg, refiner_of
from .strategy import STRATEGY, DerivativeStrategy, SamplingStrategy, Strategy, made, proposal
from .weighting import CrossEntropy, Mppi, PredictiveSampling, Tsallis, block_dim

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..cost.stack import CostStack
    from ..engine.redraw import Redraw
    from ..scene.model.compiled import CompiledScene
    from ..scene.model.properties import Properties
    from ..scene.model.trajectory import BatchSize
    from ..scene.schema import Scene
    from ..scene.task.task import AncillaryController
    from .feedback import Feedback


def register(name: str, make: Callable[..., Strategy]) -> None:
    """Add a strategy, for scene files (``planner.method``) and controllers.

    Args:
        name: The name.
        make: ``make(scene, layout, state, spline, limits, cost, *, seed)``, with the arguments of
            :class:`~warpmpc.planner.strategy.SamplingStrategy`.

    Raises:
        ValueError: If there is one of this name.
    """
    STRATEGIES.register(name, make)


for names, weighting in (
    ((Method.MPPI, Method.DIAL), Mppi.of),
    ((Method.PREDICTIVE_SAMPLING, Method.ILQS), lambda planner: PredictiveSampling()),
    ((Method.CEM, Method.ICEM), lambda planner: CrossEntropy(elites=planner.elites)),
    ((Method.TSALLIS,), lambda planner: Tsallis(elites=planner.elites, entropic_index=planner.entropic_index)),
):
    for name in names:
        register(str(name), partial(SamplingStrategy, weighting=weighting))
for name in (Method.GRADIENT_DESCENT, Method.ILQG):
    register(str(name), DerivativeStrategy)


STAGES = ("begin", "noise", "evaluate", "update")


class PlanStep:
    """One plan step over all environments, with the state it carries from plan to plan.

    Args:
        costs: The cost terms, on the device of the rollouts.
        strategy: Name of the strategy, or ``"auto"``: the scene's ``planner.method``.
        properties: Draws of physical properties of the rollouts' worlds, None for nominal ones.

    Raises:
        SceneError: If the engine cannot do what the scene asks for, or a list has the wrong number of values.
        ValueError: If there is no such strategy, or it tries more samples than there are.
    """

    command: wp.array2d[float]
    """Control to apply now, ``[E, nu]``: the one that acts when the next plan begins (``state.last_control``)."""

    def __init__(
        self,
        scene: Scene,
        compiled: CompiledScene,
        costs: CostStack,
        shape: BatchSize,
        *,
        engine: str,
        strategy: str = "auto",
        seed: int = 0,
        properties: Properties | None = None,
        ancillaries: Sequence[AncillaryController] = (),
    ):
        layout = costs.layout
        make_strategy = STRATEGIES.find(str(scene.planner.method) if strategy == "auto" else strategy, "auto")
        self.costs, self.shape, self.device = costs, shape, costs.device
        self.grid, dt = TimeGrid.of(scene), scene.timing.control_dt
        direct = refined(scene) is Refinement.ILQG and not scene.planner.finishes
        hold = control_hold(dt, self.grid) if direct else 1
        sampled = knot_times(self.grid, scene.planner.knot_count, hold)
        self.sampled = PlanSpline(scene.planner.spline, sampled)
        """Spline of the samples."""
        spline = self.sampled.table(float(self.grid.dt[0]), self.device)

        def array(values: np.ndarray) -> wp.array:
            return wp.array(values, dtype=float, device=self.device)

        self.limits = (array(layout.control_lower), array(layout.control_upper))
        self.ancillaries = Ancillaries(scene, layout, costs.task, sampled, ancillaries)
        """Proposers on the host."""
        proposed = self.ancillaries.columns
        self.state = ObservedState.allocate(layout, costs.task, self.device, proposed=proposed)
        request = EngineRequest(
            scene=scene,
            compiled=compiled,
            shape=shape,
            grid=self.grid,
            spline=spline,
            limits=self.limits,
            state=self.state,
            costs=costs,
            device=self.device,
            properties=properties,
        )
        entry, self.engine = make_engine(engine, request)
        self._redraw: Redraw | None = getattr(self.engine, "redraw", None)
        on_gpu = wp.get_device(self.device).is_cuda
        plan = (scene, layout, self.state, spline, self.limits, self.engine.cost)
        names = "population knots mean offset eta update"
        self.strategy = made(make_strategy, STRATEGY, names, scene, *plan, seed=seed)
        if (most := max(self.strategy.population, default=0)) > shape.samples:
            kind = type(self.strategy).__name__
            raise ValueError(f"strategy {kind}: its population has {most} samples, planner.samples are {shape.samples}")
        self.refiner = refiner_of(entry.name, request, self.engine, self.strategy, physics=entry.physics)
        """Improves the samples' plan by derivatives, None without."""
        kernels_alone = entry.capturable and costs.capturable and on_gpu
        self.capturable = kernels_alone and self.refiner is None
        """True where a CUDA graph can hold a plan."""
        self.plan_spline = self.sampled
        """Spline of the plans that are handed out, their knots ``[E, P, nu]``, and the time from the first of these to
        the present ``[E]`` [s]."""
        self.knots, self.offset, self.spline = self.strategy.mean, self.strategy.offset, spline
        if isinstance(self.refiner, SampledIlqg):
            self.plan_spline, self.spline = self.refiner.plan, self.refiner.spline
            self.knots, self.offset = self.refiner.knots, self.refiner.offset
        self._launch = Launcher(self.device)
        self._sequence = self.sequence()
        if kernels_alone and self.refiner:
            self._sequence = self._sampling_captured(self._sequence)
        self.command = wp.zeros((shape.envs, layout.nu), dtype=float, device=self.device)
        self.stages = dict.fromkeys(STAGES, 0.0)
        """Wall time of each stage of the last plan [s]."""
        self.reset()

    def reset(self, plan: Plan | None = None) -> None:
        """Forget every earlier plan; the next one starts from ``plan`` if there is one."""
        knots = [] if plan is None else [refitted(plan, self.sampled.kind, self.sampled.times)]
        self.strategy.reset(*knots)
        for first in (k[..., 0, :] for k in knots):
            self.command.assign(np.broadcast_to(first, self.command.shape).astype(np.float32))
        if self.refiner:
            self.refiner.reset()
        self.ancillaries.reset()
        self.costs.reset()
        if self._redraw:
            self._redraw.reset()

    def __call__(self) -> None:
        """Plan from :attr:`state`; the result is in :attr:`command`. Capture-safe where the engine is."""
        self.stages = dict.fromkeys(STAGES, 0.0)
        start = time.perf_counter()
        for stage, run in self._sequence:
            run()
            end = time.perf_counter()
            self.stages[stage] += end - start
            start = end

    @property
    def feedback(self) -> Feedback | None:
        """Gains of the last plan, None without."""
        return self.refiner.feedback if self.refiner else None

    def sequence(self) -> list[tuple[str, Callable[[], None]]]:
        """The plan step in order, each piece with the stage it belongs to."""
        strategy, engine = self.strategy, self.engine
        pieces = [("begin", self._replayed(self._begin))]
        for i in range(len(strategy.population)):
            pieces += [
                ("noise", self._replayed(partial(strategy.advance, i))),
                ("evaluate", partial(engine.evaluate, proposal(strategy, i))),
                ("update", self._replayed(partial(strategy.update, i))),
            ]
        if self.refiner:
            pieces.append(("update", self.refiner))
        return [*pieces, ("update", self._replayed(self._finish))]

    def _sampling_captured(self, pieces: list[tuple[str, Callable[[], None]]]) -> list[tuple[str, Callable[[], None]]]:
        """The plan step with all before the refiner, which works on the host, too, as one CUDA graph."""
        sampling, rest = pieces[:-2], pieces[-2:]

        def sample() -> None:
            for _, piece in sampling:
                piece()

        return [("evaluate", CapturedLaunches(sample, blocks=True, device=self.device)), *rest]

    def _replayed(self, piece: Callable[[], None]) -> Callable[[], None]:
        """A piece that is launches alone; on CUDA the graph of the whole plan replays it."""
        return piece if wp.get_device(self.device).is_cuda else CapturedLaunches(piece, blocks=True)

    def _begin(self) -> None:
        """Let resources and plans follow the observed state."""
        wp.copy(self.state.last_control, self.command)
        if self._redraw:
            self._redraw()
        self.costs.before_plan(self.state)
        self.strategy.shift()

    def _finish(self) -> None:
        self._launch(
            command_kernel,
            self.command.shape,
            [self.knots, self.spline, *self.limits, self.offset],
            [self.command],
        )


def knot_times(grid: TimeGrid, knots: int | None, hold: int = 1) -> np.ndarray:
    """Times of P knots after the first ``[P]`` [s]: one at the start of every step, or fewer, from end to end, evenly.

    Args:
        grid: Steps of the horizon.
        knots: Number of knots, one per step if None.
        hold: Steps that a knot is for if there is no number of them.
    """
    if knots is None or knots == grid.steps:
        return grid.t[:-1:hold]
    return np.linspace(0.0, grid.t[-2], knots)


LANES = 32
"""Threads of a GPU that share an environment's numbers."""


class PlanGraph:
    """Runs a plan step on packed observations and reports what came of it.

    On a CUDA device the first plan runs launch by launch, which loads the kernels; then the same sequence is captured
    and later plans replay it. Terms that are plain functions over arrays cannot be captured: with one of them every
    plan runs launch by launch. With derivatives all before them is one graph, rollouts under feedback and differences
    one each, and the host works between them.
    """

    def __init__(self, plan: PlanStep):
        self.plan = plan
        self.device = wp.get_device(plan.device)
        self._launch = Launcher(self.device)
        self._kept: list[wp.array] = []
        envs, terms = plan.shape.envs, len(plan.costs.labels)
        cuda = self.device.is_cuda
        self._nu, self._terms, self._knots = plan.command.shape[1], terms, plan.knots.shape
        state = plan.state
        widths = [3, state.joint_q.shape[1], state.joint_qd.shape[1], state.act.shape[1], 7 * state.mocap.shape[1]]
        self._observed_columns = slice(3, sum(widths))
        widths += [state.proposed.shape[1], plan.costs.task.block.shape[1]]

        reported = self._nu + int(REPORT) + terms + self._knots[1] * self._nu + 1
        self._packed, self._in = self._packed_arrays(envs, sum(widths))
        self._report, self._out = self._packed_arrays(envs, reported)
        self._lanes = step_lanes(LANES, self.device)
        self._best = wp.zeros(envs, dtype=int, device=self.device)
        self._best_cost = wp.zeros(envs, dtype=float, device=self.device)
        self._failures = wp.zeros((envs, 2), dtype=int, device=self.device)
        self._planned = self._views()
        pieces = (self._unpack, self._pack)
        self._take_in, self._give_out = pieces if cuda else [CapturedLaunches(piece, blocks=True) for piece in pieces]
        self.captured: wp.Graph | None = None
        self.capturable = plan.capturable

    @property
    def stages(self) -> dict[str, float]:
        """Wall time of each stage of the last plan [s]; NaN where a graph runs them all as one."""
        return self.plan.stages if self.captured is None else dict.fromkeys(self.plan.stages, float("nan"))

    @property
    def task(self) -> np.ndarray:
        """Values of the task that the last plan was made for ``[E, n]``, overwritten by the next."""
        return self._packed[:, -self.plan.costs.task.block.shape[1] :]

    def __call__(self, observed: np.ndarray, elapsed: np.ndarray, start: np.ndarray, state: np.ndarray) -> PlanReport:
        """Plan for what the task wants at present.

        Args:
            observed: Whether there is an observation to plan from ``[E]``.
            elapsed: Time since the last plan ``[E]`` [s].
            start: Time of the observation ``[E]`` [s].
            state: Joint coordinates, joint velocities, activations, poses of mocap bodies ``[E, nq + nv + na + 7 nm]``.
        """
        packed, task = self._packed, self.plan.costs.task.block
        packed[:, 0], packed[:, 1], packed[:, 2] = observed, elapsed, start
        seen = self._observed_columns
        packed[:, seen] = state
        packed[:, seen.stop : -task.shape[1]] = self.plan.ancillaries(observed, start, state, self._planned)
        packed[:, -task.shape[1] :] = task
        self.plan.costs.refresh()
        if self.captured is not None:
            wp.capture_launch(self.captured)
        else:
            self._sequence()
            if self.capturable:
                with wp.ScopedCapture(device=self.device) as capture:
                    self._sequence()
                self.captured = capture.graph
        if self.device.is_cuda:
            wp.synchronize_device(self.device)
        return self._planned

    def _packed_arrays(self, envs: int, columns: int) -> tuple[np.ndarray, wp.array]:
        """A block ``[E, columns]`` that host and device both see: a GPU reads and writes the host's pinned memory."""
        host = wp.zeros((envs, columns), dtype=float, device="cpu", pinned=self.device.is_cuda)
        self._kept.append(host)
        if not self.device.is_cuda:
            return host.numpy(), host
        return host.numpy(), wp.array(ptr=host.ptr, shape=host.shape, dtype=float, device=self.device)

    def _views(self) -> PlanReport:
        row, nu = self._report, self._nu
        numbers, at = row[:, nu : nu + int(REPORT)].T, nu + int(REPORT)
        return PlanReport(
            command=row[:, :nu],
            beta=numbers[0],
            eta=numbers[1],
            cost=numbers[2],
            best=numbers[3],
            diverged=numbers[4],
            overflow_halves=numbers[5:],
            terms=row[:, at : at + self._terms],
            knots=row[:, at + self._terms : -1].reshape(self._knots),
            offset=row[:, -1],
        )

    def _sequence(self) -> None:
        self._take_in()
        self.plan()
        self._give_out()

    def _unpack(self) -> None:
        """Spread the block that came in over the arrays of the plan."""
        state = self.plan.state
        observed = [state.observed, state.elapsed, state.start, state.joint_q, state.joint_qd, state.act]
        task = [_numbers(state.pose), state.scalar, state.weight]
        outputs = [*observed, _numbers(state.mocap), state.proposed, *task]
        self._launch(unpack_kernel, self._in.shape, [self._in], outputs)

    def _pack(self) -> None:
        """Gather what came of the plan into the block that goes out."""
        plan, strategy, engine = self.plan, self.plan.strategy, self.plan.engine
        envs = self._in.shape[0]
        inputs, outputs = [engine.cost, engine.diverged, engine.overflow], [self._best, self._best_cost, self._failures]
        self._launch(survey_kernel, envs, inputs, outputs, block_dim=block_dim(engine.cost.shape[1]))
        engine.explain(self._best)
        numbers = [plan.command, strategy.beta, strategy.eta, self._best, self._best_cost]
        arrays = [self._failures, engine.term_cost, plan.knots, plan.offset]
        self._launch(report_kernel, (envs, self._lanes), [*numbers, *arrays, self._lanes], [self._out])


def _numbers(poses: wp.array) -> wp.array:
    """The same memory of poses ``[E, n]`` as numbers ``[E, 7 n]``."""
    envs, count = poses.shape
    return wp.array(ptr=poses.ptr, shape=(envs, 7 * count), dtype=float, device=poses.device)
