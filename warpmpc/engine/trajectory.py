# SPDX-License-Identifier: Apache-2.0
"""What engines write and costs read: the recorded rollouts of all worlds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
import warp as wp

from ..task.observed import ObservedState

if TYPE_CHECKING:
    from ..launch import Replay
    from ..model.batch_size import BatchSize
    from ..model.layout import Layout


@dataclass(frozen=True)
class Trajectory:
    """Recorded rollouts. Slice t of the state arrays is the state after t controls; slice 0 the observed state."""

    joint_q: wp.array  # [T+1, W, nq]
    joint_qd: wp.array  # [T+1, W, nv]
    body_q: wp.array  # [T+1, W, nb] transform
    body_qd: wp.array  # [T+1, W, nb] spatial vector: linear velocity of the centre of mass, angular velocity
    contact_force: wp.array  # [T, W, pairs] vec3 [N], world frame, on the first of the pair
    diverged: wp.array  # [W] nonzero where the world blew up
    overflow: wp.array  # [W] bits of the solver's capacities that did not suffice
    act: wp.array  # [T+1, W, na] activations
    sensor: wp.array  # [T, W, ns] what the sensors that terms read show at the last physics step; zero for others

    @classmethod
    def allocate(cls, shape: BatchSize, layout: Layout, pairs: int, device: str) -> Trajectory:
        """Storage for the rollouts of a scene on a device."""
        t, w = shape.horizon + 1, shape.worlds
        return cls(
            joint_q=wp.zeros((t, w, layout.nq), dtype=float, device=device),
            joint_qd=wp.zeros((t, w, layout.nv), dtype=float, device=device),
            body_q=wp.zeros((t, w, layout.nb), dtype=wp.transform, device=device),
            body_qd=wp.zeros((t, w, layout.nb), dtype=wp.spatial_vector, device=device),
            contact_force=wp.zeros((t - 1, w, pairs), dtype=wp.vec3, device=device),
            diverged=wp.zeros(w, dtype=int, device=device),
            overflow=wp.zeros(w, dtype=int, device=device),
            act=wp.zeros((t, w, layout.na), dtype=float, device=device),
            sensor=wp.zeros((t - 1, w, layout.ns), dtype=float, device=device),
        )


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
        """Roll controls [T, W, nu] of all worlds out from the cloned state into :attr:`trajectory`."""

    def rollout_part(self, control: wp.array, part: int) -> None:
        """Roll controls [T, W, nu] of the worlds of one part out."""

    def overflow_message(self, bits: int) -> str:
        """What overflowed and which setting to raise."""

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


class Proposal(Protocol):
    """Where an engine gets its knots from."""

    knots: wp.array  # [E, S, P, nu]
    offset: wp.array  # [E] time from the first knot to the present [s]

    def sample(self, first: int, count: int) -> None:
        """Write the knots of the samples in rows e·S + s from ``first`` on; capture-safe."""


class Engine(Protocol):
    """Turns knots into costs, and chosen worlds into trajectories."""

    name: str  # of its entry in the registry, which says what it can do
    device: str
    cost: wp.array  # [E, S] cost of every sample, +inf where it diverged
    term_cost: wp.array  # [E, term] of the samples explained last
    diverged: wp.array  # [W] nonzero where the physics failed
    overflow: wp.array  # [W] capacity bits

    def evaluate(self, proposal: Proposal) -> None:
        """Roll proposed knots out from the observed state and judge them, into :attr:`cost`."""

    def explain(self, sample: wp.array) -> None:
        """Write what each term added to the cost of one sample of every environment ``[E]``, into :attr:`term_cost`."""

    def record(self, worlds: Sequence[int]) -> np.ndarray:
        """Body poses ``[T+1, n, nb, 7]`` of some worlds of the last evaluation, on the host."""

    def overflow_message(self, bits: int) -> str:
        """What overflowed and which setting to raise."""

    def close(self) -> None:
        """Release threads and memory."""
