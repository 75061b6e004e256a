# SPDX-License-Identifier: Apache-2.0
"""The way from knots to costs, the same in every engine."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import warp as wp

from ..cost.stack import CostEvaluator
from ..kernels.planner import costs as kernels
from ..kernels.planner.costs import explain_kernel, finish_kernel
from ..kernels.planner.splines import spline_control_kernel
from ..physics.runtime.launch import CapturedLaunches, Launcher, step_lanes
from ..scene.schema import Risk
from .step_worlds import SimulatedWorlds

if TYPE_CHECKING:
    import mujoco

    from ..scene.model.trajectory import BatchSize, Trajectory
    from .protocol import EngineRequest, PhysicsSteps, Proposal, Simulator
    from .redraw import Redraw
    from .step_worlds import StepWorlds

RISKS = {risk: getattr(kernels, risk.name) for risk in Risk}
"""Modes of the kernels by the risk over domains."""


class Part(NamedTuple):
    """Samples that are taken from knots to costs together, by one thread on the CPU."""

    first: int
    """First of the units that an engine rolls out: groups of worlds, or parts of a simulator."""
    count: int
    """Number of units."""
    sample: int
    """First of the samples' rows e·S + s."""
    samples: int
    """Number of samples."""


class RolloutEngine(ABC):
    """Takes knots to costs: write the knots of a part of the samples, roll them out, evaluate, sum.

    Where a term is evaluated is data (:meth:`_place_terms`): the launch that rolls out sums it, or it is
    evaluated on what rollouts record, in the same launch or in its own.

    Args:
        request: What the engine is built for.
    """

    name: str
    mj_model: mujoco.MjModel | None = None
    """MuJoCo model whose physics the rollouts have; None where they have that of none."""
    cost: wp.array2d[float]
    """Cost of every sample, +inf where it is not finite or the physics failed, ``[E, S]``."""
    term_cost: wp.array2d[float]
    """Part of each term in the cost of the sample asked for last, ``[E, term]``."""
    total: wp.array2d[float]
    """Cost of each term of each world over the horizon ``[term, W]``."""
    diverged: wp.array[int]
    """Nonzero where the physics failed, or where there is none, where a cost is not finite, ``[W]``."""
    overflow: wp.array[int]
    """Capacity bits of every world, ``[W]``."""
    records: bool
    """True where all rollouts are recorded."""
    recorded: Trajectory
    """The record; of one world where there is none."""
    evaluator: CostEvaluator
    """Evaluates terms on the record."""
    redraw: Redraw | None = None
    """Draws the physical properties of the worlds anew before a plan, None where they stay; capture-safe."""

    def __init__(self, request: EngineRequest):
        self.request, self.device = request, request.device
        self.costs, self.shape, self.state = request.costs, request.shape, request.state
        self.layout = request.costs.layout
        self._launch, self._on_gpu = Launcher(self.device), wp.get_device(self.device).is_cuda
        self._replays: dict[int, tuple[Proposal, CapturedLaunches, list[CapturedLaunches]]] = {}
        planner, grid, shape = request.scene.planner, request.grid, self.shape
        level = planner.aversion if planner.risk is Risk.EXPONENTIAL else planner.cvar
        self._risk, self._stage_risk = [shape.domains, RISKS[planner.risk], level], planner.stage_risk
        self.grid, self.weights = grid.arrays(self.device), request.weights
        place = (grid.t[:-1] / grid.dt[0]).astype("float32") * (grid.dt[:1].astype("float32") / request.spline.knot_dt)
        self._step_place = wp.array(place, dtype=float, device=self.device)
        terms, zeros = len(self.costs.terms), self._zeros
        self.cost, self.term_cost = zeros(shape.envs, shape.samples), zeros(shape.envs, terms)
        self.total, self._rollout_cost = zeros(terms, shape.worlds), zeros(shape.worlds)

    def _zeros(self, *dims: int, dtype: type = float) -> wp.array:
        return wp.zeros(dims, dtype=dtype, device=self.device)

    def _place_terms(self, on_record: Collection[int], out: Trajectory, shape: BatchSize, *, apart: bool) -> None:
        """Say which terms are evaluated on recorded rollouts; the launch that rolls out sums all others.

        Args:
            on_record: Their numbers.
            out: The record.
            shape: Its sizes.
            apart: Whether a separate launch evaluates them.
        """
        self.recorded, self.records, self._apart = out, bool(on_record), apart
        self.evaluator = CostEvaluator(self.costs, out, out.control, self.state, shape, self.request.grid.t)
        rest = [i for i in range(len(self.costs.terms)) if i not in on_record]
        self._on_record, self._in_launch = (
            wp.array(list(numbers), dtype=int, device=self.device) for numbers in (on_record, rest)
        )

    def evaluate(self, proposal: Proposal) -> None:
        """Roll proposed knots out from the observed state and evaluate the terms, into :attr:`cost`.

        Capture-safe on CUDA, but for terms over whole arrays. On the CPU every part of the samples is a sequence of its
        own, replayed by whatever thread takes it.
        """
        if self._on_gpu:
            self._begin(proposal)
            for part in self._split(proposal.samples):
                self._evaluate_part(proposal, part)
        else:
            if id(proposal) not in self._replays:
                parts = [
                    CapturedLaunches(partial(self._evaluate_part, proposal, part))
                    for part in self._split(proposal.samples)
                ]
                self._replays[id(proposal)] = proposal, CapturedLaunches(partial(self._begin, proposal)), parts
            _, begin, parts = self._replays[id(proposal)]
            begin()
            self._run(parts)
        if not self.costs.capturable:
            self.evaluator.launch_arrays()
            self._reduce(0, self.shape.envs * self.shape.samples)

    def _evaluate_part(self, proposal: Proposal, part: Part) -> None:
        """Take a part of the samples from knots to costs."""
        proposal.sample(part.sample, part.samples)
        self._simulate(proposal, part)
        if self._apart:
            self.evaluator.launch(part.sample * self.shape.domains, part.samples * self.shape.domains)
        self._reduce(part.sample, part.samples)

    def _begin(self, proposal: Proposal) -> None:  # noqa: B027
        """Get ready for all parts."""

    @abstractmethod
    def _split(self, samples: int) -> list[Part]:
        """Parts that together try the first samples of every environment."""

    @abstractmethod
    def _run(self, replays: Sequence[CapturedLaunches]) -> None:
        """Run one sequence of launches for every part, on as many threads as there are."""

    @abstractmethod
    def _simulate(self, proposal: Proposal, part: Part) -> None:
        """Roll a part of the samples out, and evaluate the terms that are part of the launch."""

    def _reduce(self, first: int, count: int) -> None:
        """Costs of some samples from what their terms cost, at every step or over the horizon."""
        inputs = [self.evaluator.cost, self._on_record, self._in_launch, self.weights, self._stage_risk]
        inputs += [self._failed, self.state.observed, *self._risk, first]
        outputs = [self.total, self._rollout_cost, self.diverged, self.cost]
        self._launch(finish_kernel, count, inputs, outputs)

    @property
    def _failed(self) -> wp.array:
        """Worlds whose physics failed ``[W]``; empty where there is none."""
        return self.diverged

    def explain(self, sample: wp.array) -> None:
        """Write what each term added to the cost of a sample of every environment ``[E]``; capture-safe."""
        inputs = [self.total, self._rollout_cost, sample, self.shape.samples, *self._risk]
        self._launch(explain_kernel, self.term_cost.shape, inputs, [self.term_cost])

    def record(self, worlds: Sequence[int]) -> Trajectory:
        """States and controls of some worlds in the last evaluation, on the host."""
        return self.recorded.of_worlds(worlds)

    def overflow_message(self, bits: int) -> str:
        """A sentence about what overflowed."""
        return f"capacity bits {bits:#x}"

    @abstractmethod
    def close(self) -> None:
        """Release threads and memory."""


class SimulatorEngine(RolloutEngine):
    """Rolls knots out with a simulator that records them; all terms are evaluated on the record.

    Args:
        request: What the engine is built for.
        steps: Physics steps.
        make: Makes the simulator, here and for the worlds that derivatives are taken in.
        step_worlds: Worlds of the simulator's own for derivatives; any simulator's if None.
    """

    def __init__(
        self,
        request: EngineRequest,
        steps: PhysicsSteps,
        make: Callable[[EngineRequest, PhysicsSteps], Simulator],
        step_worlds: type[StepWorlds] | None = None,
    ):
        super().__init__(request)
        self.simulator = simulator = make(request, steps)
        self.redraw = getattr(simulator, "redraw", None)
        self.name, self.step_worlds = simulator.name, step_worlds or partial(SimulatedWorlds, make)
        self.mj_model = getattr(simulator, "mj_model", None)
        out = simulator.trajectory
        self.diverged, self.overflow = out.diverged, out.overflow
        self._place_terms(range(len(self.costs.terms)), out, self.shape, apart=True)

    def _split(self, samples: int) -> list[Part]:
        """Parts of the simulator that have any of the first samples of an environment among their worlds."""
        domains, rollouts = self.shape.domains, self.shape.rollouts
        return [
            Part(i, 1, first // domains, count // domains)
            for i, (first, count) in enumerate(self.simulator.parts)
            if first % rollouts < samples * domains or first // rollouts != (first + count - 1) // rollouts
        ]

    def _run(self, replays: Sequence[CapturedLaunches]) -> None:
        self.simulator.run(replays)

    def _simulate(self, proposal: Proposal, part: Part) -> None:
        first, count = self.simulator.parts[part.first]
        self.simulator.clone(self.state, first, count)
        lanes = step_lanes(self.shape.horizon, self.device)
        places = [self.grid.t, self._step_place, proposal.offset, self.shape.domains, first, lanes]
        inputs = [proposal.knots, self.request.spline, *self.request.limits, *places]
        self._launch(spline_control_kernel, (lanes, count), inputs, [self.recorded.control])
        self.simulator.rollout_part(self.recorded.control, part.first)

    def overflow_message(self, bits: int) -> str:
        """A sentence about what overflowed, and which setting to raise."""
        return self.simulator.overflow_message(bits)

    def close(self) -> None:
        """Release threads and memory."""
        self.simulator.close()
