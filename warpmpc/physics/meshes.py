# SPDX-License-Identifier: Apache-2.0
"""Convex hulls of meshes as tables: what ``native/collide_convex.h`` reads of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import mujoco
import numpy as np


@dataclass
class Hulls:
    """The hulls of a model's geoms; rows of vertices, and of the faces around each vertex."""

    vertex: list[np.ndarray] = field(default_factory=list)
    first: list[int] = field(default_factory=list)
    """First vertex of each geom."""
    count: list[int] = field(default_factory=list)
    """Vertices of each geom, none where it is no mesh."""
    face_first: list[int] = field(default_factory=lambda: [0])
    """First face of each vertex, and one more at the end."""
    face_normal: list[np.ndarray] = field(default_factory=list)
    face_vertex: list[list[int]] = field(default_factory=list)
    """The other corners of a large quadrangle in a face with the vertex, counted from the geom's first; -1 for none."""

    @classmethod
    def of(cls, model: mujoco.MjModel, geoms: set[int]) -> Hulls:
        """The hulls of a model.

        Args:
            model: The model.
            geoms: Geoms whose hulls are wanted.
        """
        out = cls()
        for g in range(model.ngeom):
            out.first.append(len(out.vertex))
            if g in geoms and model.geom_type[g] == mujoco.mjtGeom.mjGEOM_MESH:
                out._add(model, int(model.geom_dataid[g]))
            out.count.append(len(out.vertex) - out.first[-1])
        return out

    def _add(self, m: mujoco.MjModel, mesh: int) -> None:
        """Add one mesh's hull."""
        graph = m.mesh_graph[m.mesh_graphadr[mesh] :]
        ids = graph[2 + graph[0] : 2 + 2 * graph[0]].tolist()
        points = m.mesh_vert[m.mesh_vertadr[mesh] :]
        self.vertex += list(points[ids])
        first = int(m.mesh_polyadr[mesh])
        around: dict[int, list[tuple[int, list[int]]]] = {vertex: [] for vertex in ids}  # its faces, from it on
        for face in range(first, first + int(m.mesh_polynum[mesh])):
            ring = m.mesh_polyvert[m.mesh_polyvertadr[face] :][: m.mesh_polyvertnum[face]].tolist()
            for at, vertex in enumerate(ring):
                around[vertex].append((face, ring[at:] + ring[:at]))
        number = {vertex: i for i, vertex in enumerate(ids)} | {-1: -1}
        for faces in around.values():
            for face, ring in faces:
                self.face_normal.append(m.mesh_polynormal[face])
                self.face_vertex.append([number[k] for k in quadrangle(points, ring)])
            self.face_first.append(len(self.face_normal))


def quadrangle(points: np.ndarray, ring: list[int]) -> list[int]:
    """Three more corners of a large quadrangle in a convex polygon with its first corner.

    As MuJoCo: the fourth moves on as long as that helps, and after each of its steps the third and the second do.

    Args:
        points: All vertices ``[n, 3]``.
        ring: The polygon's vertices in order, the first given.

    Returns:
        Three vertices; of a triangle the other two and -1.
    """
    if len(ring) < 5:
        return [*ring[1:], -1][:3]
    corners = points[ring].astype(float).tolist()  # numbers of Python: there are thousands of areas to compare

    def area(i: int, j: int, k: int) -> float:
        first, second, third, fourth = corners[0], corners[i], corners[j], corners[k]
        ax, ay, az = third[0] - first[0], third[1] - first[1], third[2] - first[2]
        bx, by, bz = fourth[0] - second[0], fourth[1] - second[1], fourth[2] - second[2]
        x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        return math.sqrt(x * x + y * y + z * z)

    chosen, largest = [1, 2, 3], area(1, 2, 3)

    def moved(i: int) -> bool:
        nonlocal chosen, largest
        trial = [(k + (j == i)) % len(ring) for j, k in enumerate(chosen)]
        helps = (size := area(*trial)) > largest
        if helps:
            chosen, largest = trial, size
        return helps

    while moved(2):
        for i in (1, 0):
            while moved(i):
                pass
    return [ring[i] for i in chosen]
