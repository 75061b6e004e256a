# SPDX-License-Identifier: Apache-2.0
"""Path-length fields that follow their targets, on the device of the rollouts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..kernels.fields import GuideTable, guide_field_kernel, guide_target_kernel
from ..scene.layout import GOAL

if TYPE_CHECKING:
    from ..scene.layout import Layout
    from .binding import FieldRequest
    from .geodesic import Grid


class Guide:
    """The distance fields that cost terms asked for, one per environment and request.

    Fast marching is slow and runs on the host. For targets that stay (the goal, an obstacle) it runs when they are
    set. For targets that move it runs once, from waypoints on the borders of the grown obstacles to every cell; the
    field to where the target is now is put together from those on the device, at every plan whose target moved by
    more than half a cell.

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
        self.device, self._grid, self._requests, self._layout, self._envs = device, grid, requests, layout, envs
        rows, columns = grid.clearance.shape
        count = envs * len(requests)
        self.field = wp.zeros((count, rows, columns), dtype=float, device=device)
        self.center = wp.full(count, wp.vec2(wp.inf, wp.inf), dtype=wp.vec2, device=device)
        self._stale = wp.zeros(count, dtype=int, device=device)
        self._moves = [layout.frame_body[r.target] >= 0 for r in requests]
        self._placed = np.full((count, 2), np.inf)

        moving = [r.inflation if moves else None for r, moves in zip(requests, self._moves, strict=True)]
        fields = {i: [grid.path_length(p, i).ravel() for p in grid.waypoints(i)] for i in {*moving} - {None}}
        ways = [fields.get(inflation, []) for inflation in moving]
        free = [grid.nearest_free(r.inflation) for r in requests]

        def upload(values: object, dtype: type = float) -> wp.array:
            return wp.array(values, dtype=dtype, device=device)

        table = GuideTable()
        table.clearance = upload(np.minimum(grid.clearance, 1e6)[None])
        table.inflation = upload([r.inflation for r in requests])
        table.waypoint_start = upload(np.cumsum([0, *map(len, ways)]), int)
        flat = np.array([field for way in ways for field in way]).reshape(-1, rows * columns)
        table.waypoint = upload(np.ascontiguousarray(flat.T))
        table.nearest = upload(np.array([nearest for nearest, _ in free]), int)
        table.depth = upload(np.array([depth for _, depth in free]))
        table.origin, table.cell = wp.vec2(*grid.origin), grid.cell
        table.body = upload([int(layout.frame_body[r.target]) for r in requests], int)
        table.pose = upload([layout.frame_pose[r.target] for r in requests], wp.transform)
        self._table = table

    def reset(self) -> None:
        """Forget where moving targets were."""
        center = self.center.numpy().reshape(self._envs, -1, 2)
        center[:, self._moves] = np.inf
        self.center.assign(center.reshape(-1, 2))

    def set_goal(self, goal: np.ndarray) -> None:
        """Compute the fields to targets that stay.

        Args:
            goal: Goal poses ``[E, 7]``.
        """
        for f in range(len(self._placed)):
            e, r = divmod(f, len(self._requests))
            if self._moves[r]:
                continue
            target = self._requests[r].target
            pose = wp.transform(*self._layout.frame_pose[target])
            if self._layout.frame_body[target] == GOAL:
                pose = wp.transform(*goal[e]) * pose
            at = self._grid.nearest(np.array([pose.p[0], pose.p[1]], dtype=float))
            if np.linalg.norm(at - self._placed[f]) <= 1e-6:
                continue
            self._placed[f] = at
            self.field[f].assign(self._grid.path_length(at, self._requests[r].inflation).astype(np.float32))
            center = self.center.numpy()
            center[f] = at
            self.center.assign(center)

    def launch(self, body_q: wp.array, rollouts: int) -> None:
        """Bring the fields to moving targets up to date; capture-safe.

        Args:
            body_q: Recorded body poses ``[T+1, W, nb]``, of which the observed state in slice 0 is read.
            rollouts: Worlds per environment.
        """
        if not any(self._moves):
            return
        wp.launch(
            guide_target_kernel,
            dim=self.center.shape,
            inputs=[self._table, body_q, rollouts],
            outputs=[self.center, self._stale],
            device=self.device,
        )
        wp.launch(
            guide_field_kernel,
            dim=self.field.shape,
            inputs=[self._table, self.center, self._stale],
            outputs=[self.field],
            device=self.device,
        )
