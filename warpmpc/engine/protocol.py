# SPDX-License-Identifier: Apache-2.0
"""Protocols of engines, as plans use them, and of simulators, as engines use them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import warp as wp

if TYPE_CHECKING:
    from ..launch import Replay
    from ..model.batch_size import BatchSize
    from ..model.trajectory import Trajectory
    from ..task.observed import ObservedState

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

    def run(self, replays: Sequence[Replay]) -> None:
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

    def run(self, replays: Sequence[Replay]) -> None:
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
