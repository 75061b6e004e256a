# SPDX-License-Identifier: Apache-2.0
"""Path-length fields that follow their targets, on the device of the rollouts."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ...kernels.geometry.fields import (
    GuideTable,
    PathFields,
    guide_field_kernel,
    guide_target_kernel,
    guide_waypoint_kernel,
)
from ...physics.runtime.launch import Launcher
from .geodesic import Ground
from .resource import Resource

if TYPE_CHECKING:
    from ...scene.model.layout import Layout
    from ...scene.task.observed import ObservedState
    from .geodesic import Grid
    from .resource import Resources


@dataclass(frozen=True)
class FieldRequest:
    """A distance field that some term samples: path length to a frame for a mover of some size."""

    target: int
    """Frame."""
    inflation: float
    """Obstacles grow by this [m]."""


class Guides(Resource):
    """The distance fields of a stack's terms; terms that ask for the same one share it."""

    def __init__(self, resources: Resources):
        self._layout = resources.layout
        self._ground = resources.get(Ground)
        self._requests: list[FieldRequest] = []
        self._readers: list[Any] = []
        self.guide: Guide | None = None

    def request(self, params: Any, target: int, inflation: float) -> int:
        """Ask for a distance field; returns its index.

        Args:
            params: Parameters of the term, whose ``paths`` will point at the fields.
            target: Frame.
            inflation: Obstacles grow by this [m].
        """
        request = FieldRequest(target, inflation)
        if request not in self._requests:
            self._requests.append(request)
            self._ground.need(room=inflation)
        self._readers.append(params)
        return self._requests.index(request)

    def allocate(self, envs: int, device: str) -> None:
        """Prepare the waypoints, allocate the fields and point the terms at them."""
        grid = self._ground.grid
        self.guide = Guide(grid, self._requests, self._layout, envs=envs, device=device)
        for params in self._readers:
            params.paths = self.guide.view

    def before_plan(self, observed: ObservedState) -> None:
        """Bring the fields to their targets; capture-safe."""
        self.guide.launch(observed.body_q, observed.pose)

    def reset(self) -> None:
        """Forget where the targets were."""
        self.guide.reset()


@functools.lru_cache(maxsize=8)
def _recent(grid: Grid, inflation: float) -> tuple[np.ndarray, ...]:
    """Ways on a grid and its nearest free cells; what judges an episode, and the next episode, ask for them anew."""
    return *grid.ways(inflation), *grid.nearest_free(inflation)


class Guide:
    """Distance fields that follow their targets, one per environment and request.

    The host prepares, once, waypoints on the borders of the grown obstacles: what they see and how far apart they are.
    The field to a target is put together from those on the device, at every plan whose target moved by more than a
    cell; so nothing waits for the host while objects move.

    Args:
        grid: Grid over the scene.
        requests: What the cost terms asked for, R of them.
        layout: Layout of the scene.
        envs: Number of environments E.
        device: Warp device.
    """

    field: wp.array3d[float]
    """Path length from every cell to the target of field e·R + r, ``[E·R, rows, columns]`` [m]."""
    center: wp.array[wp.vec2]
    """Where those targets were, ``[E·R]`` [m]."""

    def __init__(self, grid: Grid, requests: list[FieldRequest], layout: Layout, *, envs: int, device: str):
        self.device, self._launch = device, Launcher(device)
        known = {i: _recent(grid, i) for i in {r.inflation for r in requests}}
        sights, betweens, nearests, depths = zip(*(known[r.inflation] for r in requests), strict=True)
        counts = [len(b) for b in betweens]
        rows, columns = grid.clearance.shape
        most, count = max(counts), envs * len(requests)
        sight = np.full((len(requests), rows * columns, most), np.inf, dtype=np.float32)
        between = np.full((len(requests), most, most), np.inf, dtype=np.float32)
        for r, m in enumerate(counts):
            sight[r, :, :m], between[r, :m, :m] = sights[r], betweens[r]

        def upload(values: object, dtype: type = float) -> wp.array:
            return wp.array(values, dtype=dtype, device=device)

        table = GuideTable()
        table.clearance = upload(np.minimum(grid.clearance, 1e6)[None])
        table.inflation = upload([r.inflation for r in requests])
        table.count = upload(counts, int)
        table.sight, table.between = upload(sight), upload(between)
        table.nearest, table.depth = upload(np.array(nearests), int), upload(np.array(depths))
        table.origin, table.cell = wp.vec2(*grid.origin), grid.cell
        table.body = upload([int(layout.frame_body[r.target]) for r in requests], int)
        table.pose = upload([layout.frame_pose[r.target] for r in requests], wp.transform)
        self._table = table
        self.field = wp.zeros((count, rows, columns), dtype=float, device=device)
        self.center = wp.empty(count, dtype=wp.vec2, device=device)
        self._stale = wp.zeros(count, dtype=int, device=device)
        self._remaining = wp.zeros((count, most), dtype=float, device=device)
        self.view = PathFields()
        """The fields as cost terms read them."""
        self.view.length, self.view.center = self.field, self.center
        self.view.origin, self.view.cell, self.view.count = wp.vec2(*grid.origin), grid.cell, len(requests)
        self.reset()

    def reset(self) -> None:
        """Forget where the targets were; capture-safe."""
        self.center.fill_(wp.vec2(wp.inf, wp.inf))

    def launch(self, body_q: wp.array, pose: wp.array) -> None:
        """Bring the fields up to date; capture-safe.

        Args:
            body_q: Observed body poses ``[E, nb]``.
            pose: The task's poses ``[E, poses]``.
        """
        targets = [self.center, self._stale]
        for kernel, dim, inputs, outputs in (
            (guide_target_kernel, self.center.shape, [body_q, pose], targets),
            (guide_waypoint_kernel, self._remaining.shape, targets, [self._remaining]),
            (guide_field_kernel, self.field.shape, [*targets, self._remaining], [self.field]),
        ):
            self._launch(kernel, dim, [self._table, *inputs], outputs)
