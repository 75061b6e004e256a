# SPDX-License-Identifier: Apache-2.0
"""Trajectories that engines write and costs read: the recorded rollouts of all worlds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..launch import capturing
from .memory import require_memory

if TYPE_CHECKING:
    from .batch_size import BatchSize
    from .layout import Layout


@dataclass(frozen=True)
class Trajectory:
    """Recorded rollouts. Slice t of the state arrays is the state after t controls; slice 0 the observed state.

    Engines write into arrays on their device; what :meth:`of_worlds` returns are NumPy arrays, whose last axis takes
    the seven numbers of a pose, the six of a twist or the three of a force.
    """

    joint_q: wp.array  # [T+1, W, nq]
    joint_qd: wp.array  # [T+1, W, nv]
    body_q: wp.array  # [T+1, W, nb] transform
    body_qd: wp.array  # [T+1, W, nb] spatial vector: linear velocity of the centre of mass, angular velocity
    contact_force: wp.array  # [T, W, pairs] vec3 [N], world frame, on the first of the pair
    diverged: wp.array  # [W] nonzero where the world blew up
    overflow: wp.array  # [W] bits of the solver's capacities that did not suffice
    act: wp.array  # [T+1, W, na] activations
    sensor: wp.array  # [T, W, ns] what the sensors that terms read show at the last physics step; zero for others
    control: wp.array  # [T, W, nu] what a plan's engine rolls out

    @classmethod
    def allocate(cls, shape: BatchSize, layout: Layout, pairs: int, device: str) -> Trajectory:
        """Storage for the rollouts of a scene on a device.

        Raises:
            SceneError: If there is not enough memory for it.
        """
        t, w = shape.horizon + 1, shape.worlds
        cure = "lower planner.samples, planner.horizon or the number of environments"
        needed = cls.bytes(shape, layout, pairs)
        require_memory(needed, device, f"records of {w} worlds × {t - 1} steps", key="planner.samples", cure=cure)
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
            control=wp.zeros((t - 1, w, layout.nu), dtype=float, device=device),
        )

    @staticmethod
    def bytes(shape: BatchSize, layout: Layout, pairs: int) -> int:
        """Memory that :meth:`allocate` takes."""
        state = layout.nq + layout.nv + 13 * layout.nb + layout.na  # a pose and a twist for every body
        step = 3 * pairs + layout.ns + layout.nu
        return 4 * shape.worlds * ((shape.horizon + 1) * state + shape.horizon * step + 2)

    def of_worlds(self, worlds: Sequence[int]) -> Trajectory:
        """A copy of some worlds' rollouts on the host, W being as many as they are and in their order."""
        rows, on_host = np.asarray(worlds, dtype=np.int32), self.joint_q.device.is_cpu

        def chosen(array: wp.array) -> np.ndarray:
            axis = min(array.ndim - 1, 1)
            if on_host:
                return array.numpy().take(rows, axis=axis)
            # gathered over there: all worlds together may be hundreds of megabytes
            return wp.indexedarray(array, [index if i == axis else None for i in range(array.ndim)]).numpy()

        with capturing:
            index = None if on_host else wp.array(rows, dtype=int, device=self.joint_q.device)
            return Trajectory(**{field.name: chosen(getattr(self, field.name)) for field in fields(self)})
