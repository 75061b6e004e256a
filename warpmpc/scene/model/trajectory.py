# SPDX-License-Identifier: Apache-2.0
"""Trajectories that engines write and costs read: the recorded rollouts of all worlds.

Sizes of a batch of rollouts.

Amount of memory, and an error in place of a machine that swaps or kills.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ...physics.runtime.launch import capturing
from ..errors import SceneError

if TYPE_CHECKING:
    from .layout import Layout

CGROUP = Path("/sys/fs/cgroup")
"""Where Linux says what a container may use."""


def free_memory(device: wp.DeviceLike) -> int:
    """Bytes that can still be allocated on a device."""
    device = wp.get_device(device)
    if device.is_cuda:
        return device.free_memory
    found = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    with contextlib.suppress(OSError, ValueError, IndexError):
        lines = Path("/proc/meminfo").read_text().splitlines()
        found += [1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    with contextlib.suppress(OSError, ValueError):
        most, used = (int((CGROUP / name).read_text()) for name in ("memory.max", "memory.current"))
        found += [most - used + _page_cache()]
    return min(found)


def _page_cache() -> int:
    """Bytes of files that a container has read and not used since: its own, but given up when memory is short."""
    with contextlib.suppress(OSError, ValueError):
        for line in (CGROUP / "memory.stat").read_text().splitlines():
            name, _, value = line.partition(" ")
            if name == "inactive_file":
                return int(value)
    return 0


def require_memory(needed: int, device: wp.DeviceLike, what: str, *, key: str, cure: str) -> None:
    """Refuse what does not fit.

    Args:
        needed: Bytes.
        device: Where they would be allocated.
        what: What they are for.
        key: Key of the scene that they grow with.
        cure: What to do about it.

    Raises:
        SceneError: If there is less; the caller knows the file.
    """
    if needed < 2**26:
        return  # always there, and asking takes longer
    free = free_memory(device)
    if needed > free:
        raise SceneError(f"{what} need {size(needed)} of memory, {size(free)} are free on {device}: {cure}", key=key)


def size(count: float) -> str:
    """A number of bytes as people say it."""
    for unit in ("B", "kB", "MB"):
        if count < 1000.0:
            return f"{count:.3g} {unit}"
        count /= 1000.0
    return f"{count:.3g} GB"


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


@dataclass(frozen=True)
class BatchSize:
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
