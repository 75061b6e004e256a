# SPDX-License-Identifier: Apache-2.0
"""The plan step: begin (shift) → n × (sample → evaluate → update) → command. Every strategy is this one step."""

from __future__ import annotations

import time
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..engine.registry import EngineRequest, make_engine
from ..engine.timegrid import TimeGrid
from ..kernels.planning.splines import command_kernel
from ..launch import Launcher, Replay
from ..registry import STRATEGIES
from ..task.observed import ObservedState
from . import registry  # noqa: F401 (the shipped strategies)
from .ancillary import Ancillaries
from .plan import Plan, refitted
from .refine import control_hold, refiner_of
from .splines import spline_table
from .strategy import proposal

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ..cost.stack import CostStack
    from ..engine.redraw import Redraw
    from ..model.batch_size import BatchSize
    from ..model.compiled import CompiledScene
    from ..model.properties import Properties
    from ..scene.schema import Scene
    from ..task.ancillary import AncillaryController
    from .feedback import Feedback

STAGES = ("begin", "noise", "evaluate", "update")


class PlanStep:
    """One plan step over all environments, with the state it carries from plan to plan.

    Args:
        costs: The cost terms, on the device of the rollouts.
        strategy: Name of the strategy, or ``"auto"``: the scene's ``planner.method``.
        properties: Draws of physical properties of the rollouts' worlds, None for nominal ones.

    Raises:
        SceneError: If the engine cannot do what the scene asks for, or a list has the wrong number of values.
        ValueError: If there is no such strategy, its methods have their names of before, or it tries more samples than
            there are.
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
        self.grid, self.kind = TimeGrid.of(scene), scene.planner.spline
        self.knot_time = knot_times(self.grid, scene.planner.knot_count, control_hold(scene))
        """Times of the knots after the first ``[P]`` [s]."""
        spline = spline_table(self.kind, self.knot_time, float(self.grid.dt[0]), self.device)

        def array(values: np.ndarray) -> wp.array:
            return wp.array(values, dtype=float, device=self.device)

        self.limits = (array(layout.control_lower), array(layout.control_upper))
        self.ancillaries = Ancillaries(scene, layout, costs.task, self.knot_time, ancillaries)
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
        self.strategy = make_strategy(scene, layout, self.state, spline, self.limits, self.engine.cost, seed=seed)
        kind = type(self.strategy).__name__
        if hasattr(self.strategy, "propose"):
            raise ValueError(f"strategy {kind}: rename its method propose to advance, and sample to sample_knots")
        if (most := max(self.strategy.population, default=0)) > shape.samples:
            raise ValueError(f"strategy {kind}: its population has {most} samples, planner.samples are {shape.samples}")
        self.refiner = refiner_of(entry.name, request, self.engine, self.strategy)
        """Improves the samples' plan by derivatives, None without."""
        kernels_alone = entry.capturable and costs.capturable and on_gpu
        self.capturable = kernels_alone and self.refiner is None
        """True where a CUDA graph can hold a plan."""
        self.spline, self._launch = spline, Launcher(self.device)
        self._sequence = self.sequence()
        if kernels_alone and self.refiner:
            self._sequence = self._sampling_captured(self._sequence)
        self.command = wp.zeros((shape.envs, layout.nu), dtype=float, device=self.device)
        self.stages = dict.fromkeys(STAGES, 0.0)
        """Wall time of each stage of the last plan [s]."""
        self.reset()

    def reset(self, plan: Plan | None = None) -> None:
        """Forget every earlier plan; the next one starts from ``plan`` if there is one."""
        knots = [] if plan is None else [refitted(plan, self.kind, self.knot_time)]
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

        return [("evaluate", Replay(sample, blocks=True, device=self.device)), *rest]

    def _replayed(self, piece: Callable[[], None]) -> Callable[[], None]:
        """A piece that is launches alone; on CUDA the graph of the whole plan replays it."""
        return piece if wp.get_device(self.device).is_cuda else Replay(piece, blocks=True)

    def _begin(self) -> None:
        """Let resources and plans follow the observed state."""
        wp.copy(self.state.last_control, self.command)
        if self._redraw:
            self._redraw()
        self.costs.before_plan(self.state)
        self.strategy.shift()

    def _finish(self) -> None:
        """Write the command."""
        self._launch(
            command_kernel,
            self.command.shape,
            [self.strategy.mean, self.spline, *self.limits, self.strategy.offset],
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
