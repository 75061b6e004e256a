# SPDX-License-Identifier: Apache-2.0
"""The grid over the ground plane that distance fields and push values of a scene share."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from .geodesic import Grid
from .resource import Resource

if TYPE_CHECKING:
    from .resource import Resources

CELL = 0.05
"""Cell of the grid [m], if no term asks for a finer one, ..."""
LEAST_CELL = 0.01
"""... down to this: memory and time of searches grow with its square."""
MARGIN = 1.0
"""Space around everything in the scene [m], if no term asks for more cells."""


class Ground(Resource):
    """A grid that covers starts, goal and obstacles, as fine and as wide as the terms ask for."""

    def __init__(self, resources: Resources):
        self._scene, self._layout = resources.scene, resources.layout
        self._cells = [CELL]
        self._margins: list[int] = []
        self._room = [0.0]

    def need(self, *, room: float, cell: float = CELL, margin: int = 0) -> None:
        """Say what a term needs, before the grid is made.

        Args:
            room: How far around everything things move or obstacles grow [m].
            cell: Largest cell [m].
            margin: Cells around everything in the scene.
        """
        self._cells.append(cell)
        self._room.append(room)
        if margin:
            self._margins.append(margin)

    def allocate(self, envs: int, device: str) -> None:
        """Nothing lives on the device."""

    @cached_property
    def grid(self) -> Grid:
        """The grid; made when it is first used."""
        scene, layout = self._scene, self._layout
        starts = [item.position[:2] for item in (*scene.object, *scene.robot) if item.position]
        for robot in scene.robot:
            moving = [j for j in layout.entity(robot.name).joints if layout.joint_dof_dim[j].any()]
            axes = "".join("xr"[i] * n for j in moving for i, n in enumerate(layout.joint_dof_dim[j]))
            if axes.startswith("xx"):  # a base that moves in the plane
                q = layout.joint_q_start[moving[0]]
                starts.append(np.add((robot.position or (0.0, 0.0))[:2], layout.joint_q[q : q + 2]))
        goals = [pose.position[:2] for pose in (scene.goal, *scene.target) if pose is not None]
        goals += [phase.goal.position[:2] for phase in scene.phase if phase.goal is not None]
        points = np.array([*goals, *starts], dtype=float)
        supports = {obstacle.name for obstacle in scene.obstacle if obstacle.support}
        if not self._margins:
            return Grid(layout, points, supports=supports, cell=CELL, margin=MARGIN)
        cell = max(min(self._cells), LEAST_CELL)
        margin = max(max(self._margins) * cell, max(self._room) + 5 * cell)
        return Grid(layout, points, supports=supports, cell=cell, margin=margin)
