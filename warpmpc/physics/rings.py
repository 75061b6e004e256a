# SPDX-License-Identifier: Apache-2.0
"""Faces of flat shapes as tables: what ``native/manifold.h`` clips against one another."""

from __future__ import annotations

from weakref import WeakKeyDictionary

import mujoco
import numpy as np

from .base import BOX, CYLINDER, MESH
from .model import CONVEX, FLAT, PhysicsModel
from .tables import floats, ints

RIM = 16
"""Points of a cylinder's rim."""
MOST_CORNERS = 32
"""Corners of a mesh's face that are kept, since the time to clip two faces grows with the square of their number. Of a
regular polygon none of the others is farther outside than 0.018 of its radius; a cylinder's rim is 0.019."""


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
