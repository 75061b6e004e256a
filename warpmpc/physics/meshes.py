# SPDX-License-Identifier: Apache-2.0
"""Tables of meshes, by their convex hulls, and of heightfields, for ``native/collide_convex.h`` and ``field.h``.

Faces of flat shapes as tables: what ``native/manifold.h`` clips against one another.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from weakref import WeakKeyDictionary

import mujoco
import numpy as np

from .base import BOX, CYLINDER, MESH
from .model import CONVEX, FLAT, PhysicsModel
from .source_parts import floats, ints


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
            if g in geoms and model.geom_type[g] == MESH:
                out._add(model, int(model.geom_dataid[g]))
            out.count.append(len(out.vertex) - out.first[-1])
        return out

    def _add(self, m: mujoco.MjModel, mesh: int) -> None:
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


def touching_meshes(model: PhysicsModel) -> set[int]:
    """Geoms that are meshes and may touch something."""
    return {g for pair in model.pairs for g in pair.geoms if model.mj.geom_type[g] == MESH}


def mesh_tables(model: PhysicsModel) -> list[str]:
    """Definitions of the tables of hulls, none if no mesh may touch anything."""
    if not (geoms := touching_meshes(model)):
        return []
    hulls = Hulls.of(model.mj, geoms)
    return [
        floats("mesh_vertex", hulls.vertex),
        ints("mesh_first", hulls.first),
        ints("mesh_count", hulls.count),
        ints("mesh_face_first", hulls.face_first),
        floats("mesh_face_normal", hulls.face_normal),
        ints("mesh_face_vertex", hulls.face_vertex),
    ]


def field_tables(model: PhysicsModel) -> list[str]:
    """Definitions of the tables of heightfields, none if nothing touches or sees one."""
    m, first = model.mj, model.fields
    if not first:
        return []
    of = [max(0, int(m.geom_dataid[g])) if g in first else 0 for g in range(m.ngeom)]
    return [
        ints("field_first", [first.get(g, 0) for g in range(m.ngeom)]),
        ints("field_rows", m.hfield_nrow[of]),
        ints("field_columns", m.hfield_ncol[of]),
        floats("field_size", m.hfield_size[of]),
    ]


RIM = 16
"""Points of a cylinder's rim."""
MOST_CORNERS = 32
"""Corners of a mesh's face that are kept, since the time to clip two faces grows with the square of their number. Of a
regular polygon no other is farther outside than 0.018 of its radius; a cylinder's rim is 0.019."""


_known: WeakKeyDictionary[PhysicsModel, dict] = WeakKeyDictionary()
"""Faces of the meshes of models whose tables are being written."""


def flat_geoms(model: PhysicsModel) -> set[int]:
    """Geoms that may have several contacts with another by the general collision of convex shapes."""
    m = model.mj
    if model.off("MULTICCD"):
        return set()
    kinds = {pair.geoms: tuple(int(m.geom_type[g]) for g in pair.geoms) for pair in model.pairs}
    return {g for geoms, kind in kinds.items() if kind in CONVEX and FLAT.issuperset(kind) for g in geoms}


def faces(m: mujoco.MjModel, mesh: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Normal ``[3]`` and corners ``[n, 3]`` of each face of a mesh's hull, counterclockwise seen from outside."""
    points = m.mesh_vert[m.mesh_vertadr[mesh] :]
    out = []
    for face in range(int(m.mesh_polyadr[mesh]), int(m.mesh_polyadr[mesh] + m.mesh_polynum[mesh])):
        ring = m.mesh_polyvert[m.mesh_polyvertadr[face] :][: m.mesh_polyvertnum[face]]
        normal, corners = m.mesh_polynormal[face], points[ring]
        sides = np.roll(corners, -1, axis=0) - corners
        turn = np.cross(corners, sides).sum(axis=0) @ normal
        out.append((normal, fewer(corners if turn > 0.0 else corners[::-1])))
    return out


def fewer(corners: np.ndarray) -> np.ndarray:
    """At most :data:`MOST_CORNERS` corners ``[n, 3]`` of a convex polygon: the flattest are left out one by one."""
    while len(corners) > MOST_CORNERS:
        before, after = np.roll(corners, 1, axis=0), np.roll(corners, -1, axis=0)
        lost = np.linalg.norm(np.cross(corners - before, after - before), axis=1)
        corners = np.delete(corners, lost.argmin(), axis=0)
    return corners


def ring_faces(model: PhysicsModel) -> dict[int, list[tuple[np.ndarray, np.ndarray]]]:
    """The :func:`faces` of each mesh that may have several contacts, by geom."""
    if model not in _known:
        m = model.mj
        _known[model] = {g: faces(m, int(m.geom_dataid[g])) for g in flat_geoms(model) if m.geom_type[g] == MESH}
    return _known[model]


def ring_size(model: PhysicsModel) -> int:
    """Most corners of a face that may have several contacts, 0 where no pair has any."""
    kinds = {int(model.mj.geom_type[g]) for g in flat_geoms(model)} - {MESH}
    corners = (len(corners) for rows in ring_faces(model).values() for _, corners in rows)
    return max([0, *({BOX: 4, CYLINDER: RIM}.get(kind, 2) for kind in kinds), *corners])


def ring_tables(model: PhysicsModel, size: int) -> list[str]:
    """Tables of the faces.

    Args:
        model: The model.
        size: Corners that each has room for.
    """
    if not size:
        return []
    first, rows = [], []
    for g in range(model.mj.ngeom):
        first.append(len(rows))
        rows += ring_faces(model).get(g, [])
    angles = 2.0 * np.pi / RIM * np.arange(RIM)
    return [
        ints("ring_first", first),
        ints("ring_count", np.diff([*first, len(rows)])),
        floats("ring_normal", [normal for normal, _ in rows]),
        ints("ring_size", [len(corners) for _, corners in rows]),
        floats("ring_corner", [corners[[*range(len(corners)), *[-1] * (size - len(corners))]] for _, corners in rows]),
        floats("ring_rim", np.stack([np.cos(angles), np.sin(angles)], axis=1)),
    ]
