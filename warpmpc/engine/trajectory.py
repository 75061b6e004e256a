# SPDX-License-Identifier: Apache-2.0
"""What engines write and costs read: the recorded rollouts of all worlds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import warp as wp

if TYPE_CHECKING:
    from ..model.layout import Layout


@dataclass(frozen=True)
class Shape:
    """Sizes of a batch of rollouts: E environments × S samples × D domains, T control steps."""

    envs: int
    samples: int
    domains: int
    horizon: int

    @property
    def rollouts(self) -> int:
        """Rollouts per environment, K = S·D."""
        return self.samples * self.domains

    @property
    def worlds(self) -> int:
        """Worlds in all, W = E·S·D; world w = (e·S + s)·D + d."""
        return self.envs * self.rollouts


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
    def allocate(cls, shape: Shape, layout: Layout, pairs: int, device: str) -> Trajectory:
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


@dataclass(frozen=True)
class ObservedState:
    """What the plant shows, one row per environment."""

    joint_q: wp.array  # [E, nq]
    joint_qd: wp.array  # [E, nv]
    act: wp.array | None = None  # [E, na] activations; those of the scene's start when left out
    mocap: wp.array | None = None  # [E, nm] transform, poses of mocap bodies; those of the start when left out


class Engine(Protocol):
    """Rolls controls out from a state."""

    name: str
    device: str
    trajectory: Trajectory

    def clone(self, state: ObservedState) -> None:
        """Put every world into the observed state; nothing of an earlier plan remains."""

    def rollout(self, control: wp.array) -> None:
        """Roll controls [T, W, nu] out from the cloned state into :attr:`trajectory`; capture-safe on CUDA."""

    def overflow_message(self, bits: int) -> str:
        """What overflowed and which setting to raise."""

    def close(self) -> None:
        """Release threads and memory."""
