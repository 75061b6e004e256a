# SPDX-License-Identifier: Apache-2.0
"""Point clouds as distance volumes on the device of the rollouts, built anew in the plan after they change."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ...kernels.geometry.volume import (
    ABREAST,
    VolumeWork,
    built_kernel,
    scatter_kernel,
    sweep_row_kernel,
    sweep_x_kernel,
    sweep_y_kernel,
    sweep_z_kernel,
)
from ...physics.runtime.launch import Launcher, capturing
from .resource import Resource

if TYPE_CHECKING:
    from ...scene.schema_bodies import Cloud
    from ...scene.task.observed import ObservedState
    from ...scene.task.task import Task
    from .resource import Resources


class PointClouds(Resource):
    """The point clouds that a stack's terms look at, one volume for each cloud and environment.

    New points wait on the host until the next plan begins, are copied then, and become a volume as part of the plan.
    A plan whose points are those of the plan before costs nothing.
    """

    def __init__(self, resources: Resources):
        self._clouds = {cloud.name: cloud for cloud in resources.scene.cloud}
        self._readers: dict[str, list[Any]] = {}
        self.volumes: dict[str, CloudVolume] = {}
        """By the clouds' names."""

    def request(self, params: Any, name: str) -> Cloud:
        """Ask for a cloud's volume; returns what the scene says of the cloud.

        Args:
            params: Parameters of the term, whose ``volume`` will be filled.
            name: Name of the cloud, one of the scene's.
        """
        self._readers.setdefault(name, []).append(params)
        # what its source is written with is known before anything is allocated
        params.volume = _volume(self._clouds[name])
        return self._clouds[name]

    def allocate(self, envs: int, device: str) -> None:
        """Allocate the volumes, with nothing in them, and point the terms at them."""
        for name, readers in self._readers.items():
            self.volumes[name] = volume = CloudVolume(self._clouds[name], envs=envs, device=device)
            for params in readers:
                params.volume = volume.work.volume

    def on_task_change(self, task: Task, names: frozenset[str]) -> None:
        """Take note of new points."""
        for name in names & self.volumes.keys():
            self.volumes[name].show([task.points(name, e) for e in range(task.envs)])

    def refresh(self) -> None:
        """Hand new points over to the device; never waits."""
        for volume in self.volumes.values():
            volume.upload()

    def before_plan(self, observed: ObservedState) -> None:
        """Build volumes whose points are new; capture-safe."""
        for volume in self.volumes.values():
            volume.launch()


class CloudVolume:
    """Distances from one cloud's points, up to a reach, of voxels in a region; a volume for each environment.

    Args:
        cloud: What the scene says of the cloud.
        envs: Number of environments E.
        device: Warp device.
    """

    def __init__(self, cloud: Cloud, *, envs: int, device: str):
        self.cloud, self.envs, self.device = cloud, envs, wp.get_device(device)
        self._launch, gpu = Launcher(device), self.device.is_cuda
        nx, ny, nz = volume_size(cloud)
        self._columns, self._threads = (nx, cloud.capacity) if gpu else (1, 1)
        voxels = envs * nx * ny * nz

        def zeros(shape: int | tuple[int, int], dtype: type = int) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=device)

        work = self.work = VolumeWork()
        work.points, work.count = zeros((envs, cloud.capacity), wp.vec3), zeros(envs)
        work.version, work.built = wp.ones(envs, dtype=int, device=device), zeros(envs)
        work.occupied, work.along_z = zeros(voxels, wp.uint8), zeros(voxels, wp.uint16)
        work.reach, work.voxel = max(round(cloud.reach / cloud.voxel), 1), cloud.voxel
        work.in_plane = zeros(voxels if gpu else 0, wp.uint16)
        work.eye, work.behind = wp.vec3(*(cloud.seen_from or (0.0, 0.0, 0.0))), cloud.behind
        work.volume = _volume(cloud)
        # until it is built there is nothing near
        work.volume.distance = wp.full(voxels, (work.reach + 1) * cloud.voxel, dtype=float, device=device)
        # on a CPU the points are written where they are read
        host = [wp.clone(a, device="cpu", pinned=True) if gpu else a for a in (work.points, work.count, work.version)]
        self._host, self._rows = host, [array.numpy() for array in host]
        self._copied = wp.Event(device) if gpu else None
        self._shown: list[np.ndarray | None] = [None] * envs
        self._waiting: dict[int, np.ndarray] = {}

    @property
    def distance(self) -> np.ndarray:
        """A copy of the volume ``[E, nz, ny, nx]`` [m]."""
        return self.work.volume.distance.numpy().reshape(self.envs, *volume_size(self.cloud)[::-1]).copy()

    def show(self, points: list[np.ndarray]) -> None:
        """Take note of points ``[n, 3]`` for each environment, which do not change any more."""
        new = {e: rows for e, rows in enumerate(points) if rows is not self._shown[e]}
        self._shown, self._waiting = list(points), {**self._waiting, **new}

    def upload(self) -> None:
        """Copy points that wait; on CUDA that goes on beside the host."""
        waiting, self._waiting = self._waiting, {}
        if not waiting:
            return
        rows, count, version = self._rows
        if self._copied:
            wp.synchronize_event(self._copied)  # of the copy before, long over unless no plan came between
        for e, points in waiting.items():
            rows[e, : len(points)] = points
            count[e] = len(points)
            version[e] += 1
        if self._copied:
            self._send(waiting)

    def _send(self, envs: Iterable[int]) -> None:
        """Copy points of environments from the host's memory to the GPU's."""
        work, (points, count, version) = self.work, self._host
        with capturing:
            for e in envs:
                if self._rows[1][e]:
                    wp.copy(work.points[e], points[e], count=int(self._rows[1][e]))
            wp.copy(work.count, count)
            wp.copy(work.version, version)
            wp.get_stream(self.device).record_event(self._copied)

    def launch(self) -> None:
        """Build the volumes whose points are new; capture-safe."""
        work, columns, threads = self.work, self._columns, self._threads
        rows = self.envs * work.volume.ny
        self._launch(scatter_kernel, self.envs * threads, [work, threads], [work.occupied])
        self._launch(sweep_z_kernel, rows * columns, [work, columns], [work.along_z])
        rows *= work.volume.nz
        if self.device.is_cuda:
            self._launch(sweep_y_kernel, rows * columns, [work], [work.in_plane])
            self._launch(sweep_x_kernel, rows * columns, [work], [work.volume.distance])
        else:
            self._launch(sweep_row_kernel, rows, [work], [work.volume.distance])
        self._launch(built_kernel, self.envs, [work.version], [work.built])


def _volume(cloud: Cloud) -> Any:
    volume = VolumeWork().volume
    volume.origin, volume.inverse = wp.vec3(*cloud.low), 1.0 / cloud.voxel
    volume.nx, volume.ny, volume.nz = volume_size(cloud)
    return volume


def volume_size(cloud: Cloud) -> tuple[int, int, int]:
    """Voxels of a cloud's volume along x, y, z: it is a little longer than the region where that suits the kernels."""
    nx, ny, nz = cloud.size
    return -(-nx // ABREAST) * ABREAST, ny, nz
