# SPDX-License-Identifier: Apache-2.0
"""Protocols of engines, as plans use them, and of simulators, as engines use them.

Inputs that every engine is built from.

Times of the steps of a horizon, and their discount.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol, Self

import numpy as np
import warp as wp

from ..cost.stack import cost_weights
from ..scene.model.trajectory import BatchSize
from ..scene.schema import Growing

if TYPE_CHECKING:
    from ..cost.stack import CostStack
    from ..kernels.planner.costs import CostWeights
    from ..kernels.planner.splines import Spline
    from ..physics.runtime.launch import CapturedLaunches
    from ..scene.model.compiled import CompiledScene
    from ..scene.model.properties import Properties
    from ..scene.model.trajectory import Trajectory
    from ..scene.schema import Scene
    from ..scene.task.observed import ObservedState


@dataclass(frozen=True)
class TimeGrid:
    """T steps from the present on, and their arrays on the device of the rollouts.

    Args:
        dt: Length of each step ``[T]`` [s].
        discount: γ_t, the factor on what each step costs ``[T]``.
    """

    dt: np.ndarray
    discount: np.ndarray

    @classmethod
    def of(cls, scene: Scene) -> TimeGrid:
        """The time grid of a scene's planner: γ^t [P5], the last step times ``planner.terminal`` [S3]."""
        planner, steps = scene.planner, scene.planner.horizon
        match planner.dt:
            case None:
                dt = np.full(steps, scene.timing.control_dt)
            case Growing(first=first, last=last, constant=constant):
                grow = np.linspace(first, last, max(steps - constant + 1, 2))[1:]
                dt = np.concatenate([np.full(constant, first), grow])[:steps]
            case values:
                dt = np.array(values) if len(values) > 1 else np.full(steps, values[0])
        # a running product in the precision of the device
        discount = np.cumprod([1.0, *[planner.discount] * (steps - 1)], dtype=np.float32)
        discount[-1] *= planner.terminal
        return cls(dt.astype(np.float64), discount)

    @property
    def steps(self) -> int:
        """Number of steps T."""
        return len(self.dt)

    @property
    def even(self) -> bool:
        """True where all steps are equally long."""
        return bool(np.all(self.dt == self.dt[0]))

    @property
    def t(self) -> np.ndarray:
        """Times of the states after the present ``[T+1]`` [s], zero first."""
        if self.even:
            return self.dt[0] * np.arange(self.steps + 1)
        return np.concatenate([[0.0], np.cumsum(self.dt)])

    def arrays(self, device: str) -> TimeGridArrays:
        """The grid on a device."""

        def array(values: np.ndarray) -> wp.array:
            return wp.array(values, dtype=float, device=device)

        return TimeGridArrays(array(self.t), array(self.dt))


@dataclass(frozen=True)
class TimeGridArrays:
    """A time grid on a device."""

    t: wp.array  # [T+1] [s]
    dt: wp.array  # [T] [s]


LARGEST_SPEED = 1.0e10
"""Joint speed above which a world counts as blown up, MuJoCo's own limit [m/s or rad/s]."""


class Simulator(Protocol):
    """Rolls controls out from a state and records them."""

    name: str
    device: str
    trajectory: Trajectory

    parts: Sequence[tuple[int, int]]  # first world and number of worlds of what is rolled out together

    def clone(self, state: ObservedState, first: int = 0, count: int | None = None) -> None:
        """Put worlds into the observed state; nothing of an earlier plan remains."""

    def run(self, replays: Sequence[CapturedLaunches]) -> None:
        """Run one sequence of launches for every part, on as many threads as there are."""

    def rollout(self, control: wp.array) -> None:
        """Roll controls [T, W, nu] of all worlds, such as the trajectory's own, out into :attr:`trajectory`."""

    def rollout_part(self, control: wp.array, part: int) -> None:
        """Roll controls [T, W, nu] of the worlds of one part out."""

    def overflow_message(self, bits: int) -> str:
        """A sentence about what overflowed, and which setting to raise."""

    def close(self) -> None:
        """Release threads and memory."""


class OnePart:
    """A simulator whose worlds are one part, because its solver steps all of them in one model."""

    shape: BatchSize

    @property
    def parts(self) -> list[tuple[int, int]]:
        """First world and number of worlds of the only part."""
        return [(0, self.shape.worlds)]

    def run(self, replays: Sequence[CapturedLaunches]) -> None:
        """Run the only part's sequence of launches as it is: solvers do more than launch kernels."""
        for replay in replays:
            replay.sequence()

    def rollout_part(self, control: wp.array, part: int) -> None:
        """Roll controls out; there is but one part."""
        self.rollout(control)


def _nothing(first: int, count: int) -> None:
    """Knots that are there already."""


@dataclass(frozen=True, eq=False)
class Proposal:
    """Source of an engine's knots."""

    knots: wp.array  # [E, S, P, nu]
    offset: wp.array  # [E] time from the first knot to the present [s]
    samples: int  # of every environment, from its first on, whose costs are asked for; others need not be rolled out
    sample: Callable[[int, int], None] = _nothing  # writes so many samples from row e·S + s on; capture-safe


class Engine(Protocol):
    """Turns knots into costs, and chosen worlds into trajectories.

    Planners with derivatives ask for ``step_worlds(request, steps, worlds, residuals)`` besides, a
    :class:`~warpmpc.engine.step_worlds.StepWorlds`: every :class:`~warpmpc.engine.evaluation.SimulatorEngine` has it.
    """

    name: str  # of its entry in the registry, which says what it can do
    device: str
    cost: wp.array  # [E, S] cost of every sample, +inf where it diverged
    term_cost: wp.array  # [E, term] of the samples explained last
    diverged: wp.array  # [W] nonzero where the physics failed
    overflow: wp.array  # [W] capacity bits

    def evaluate(self, proposal: Proposal) -> None:
        """Roll proposed knots out from the observed state and evaluate the terms, into :attr:`cost`."""

    def explain(self, sample: wp.array) -> None:
        """Write what each term added to the cost of one sample of every environment ``[E]``, into :attr:`term_cost`."""

    def record(self, worlds: Sequence[int]) -> Trajectory:
        """States and controls of some worlds in the last evaluation, on the host: see :meth:`Trajectory.of_worlds`."""

    def overflow_message(self, bits: int) -> str:
        """A sentence about what overflowed, and which setting to raise."""

    def close(self) -> None:
        """Release threads and memory."""


@dataclass(frozen=True, kw_only=True)
class EngineRequest:
    """Inputs that an engine is built from."""

    scene: Scene
    compiled: CompiledScene
    shape: BatchSize
    """Sizes of the batch."""
    grid: TimeGrid
    """Times and discount of the steps of a rollout."""
    spline: Spline
    """Spline from knots to controls, on the device."""
    limits: tuple[wp.array, wp.array]
    """Lower and upper limits of the controls ``[nu]``, on the device."""
    state: ObservedState
    """Start of the rollouts, on the device."""
    costs: CostStack
    """The cost terms, on the device."""
    device: str
    properties: Properties | None = None
    """Draws of physical properties, None for nominal worlds."""

    @cached_property
    def weights(self) -> CostWeights:
        """Factors on what the terms cost at every step, on the device."""
        return cost_weights(self.state.weight, self.costs.factors, self.grid.discount)

    def worlds(self, steps: PhysicsSteps) -> dict[str, Any]:
        """Arguments that all simulators share.

        Args:
            steps: Physics steps, of one length.
        """
        return {
            "substeps": steps.count,
            "timestep": steps.length[0],
            "pairs": self.costs.pairs,
            "properties": self.properties,
        }

    def one_step(self, steps: PhysicsSteps, worlds: int) -> tuple[Self, PhysicsSteps]:
        """Request and physics steps of worlds that take one control step, so many of every environment."""
        shape, grid = BatchSize(self.shape.envs, worlds, 1, 1), TimeGrid(self.grid.dt[:1], self.grid.discount[:1])
        return replace(self, shape=shape, grid=grid), PhysicsSteps(steps.count[:1], steps.length[:1])


@dataclass(frozen=True)
class PhysicsSteps:
    """Physics steps of a rollout."""

    count: tuple[int, ...]
    """Number in each step of the rollout ``[T]``."""
    length: tuple[float, ...]
    """Length of one of them in each step of the rollout ``[T]`` [s], the same everywhere unless ``any_dt``."""
