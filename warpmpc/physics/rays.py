# SPDX-License-Identifier: Apache-2.0
"""Tables of rays from sites, and of the geoms that they may meet (``native/rays.h``)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from .base import BOX, CAPSULE, CYLINDER, ELLIPSOID, MESH, PLANE, SPHERE, rotation
from .tables import floats, ints

if TYPE_CHECKING:
    from .model import PhysicsModel
    from .sites import Sites

SHAPES = {
    "PLANE": PLANE,
    "SPHERE": SPHERE,
    "CAPSULE": CAPSULE,
    "ELLIPSOID": ELLIPSOID,
    "CYLINDER": CYLINDER,
    "BOX": BOX,
}
"""Shapes that rays meet, besides meshes."""
MOST_TRIANGLES = 5000
"""Triangles of all meshes that rays may meet."""


class Rays:
    """Rays along the z axes of sites.

    Args:
        model: The model.
        sites: Takes the frames of sites and geoms.
    """

    def __init__(self, model: PhysicsModel, sites: Sites):
        self.model, self.mj, self.sites = model, model.mj, sites
        self._rays: list[tuple[int, int, int, int]] = []

    def add(self, n: int, at: int) -> None:
        """Take a rangefinder on.

        Args:
            n: The sensor.
            at: First of its readings.
        """
        m, site = self.mj, int(self.mj.sensor_objid[n])
        frame = self._frame(int(m.site_bodyid[site]), m.site_pos[site], m.site_quat[site])
        self._rays.append((frame, int(m.site_bodyid[site]), int(m.sensor_intprm[n, 0]), at))
        if len(self._rays) == 1:
            self._geoms = [g for g in range(m.ngeom) if visible(m, g)]
            self._frames = [self._frame(int(m.geom_bodyid[g]), m.geom_pos[g], m.geom_quat[g]) for g in self._geoms]

    def _frame(self, body: int, at: np.ndarray, quat: np.ndarray) -> int:
        frame = self.sites.index(body, at, rotation(quat))
        self.sites.turned.add(frame)
        return frame

    @property
    def sizes(self) -> dict[str, int]:
        """Macros of the source."""
        out = {f"RAY_{name}": kind for name, kind in SHAPES.items()}
        triangles = triangles_of(self.mj) if self._rays else 0
        return out | {"RAYS": len(self._rays), "RAY_GEOMS": len(self._geoms) if self._rays else 0,
                      "RAY_TRIANGLES": triangles}  # fmt: skip

    def tables(self) -> list[str]:
        """Definitions of the tables."""
        if not self._rays:
            return []
        m, columns = self.mj, list(zip(*self._rays, strict=True))
        corners, first = [], [0]
        for g in self._geoms:
            mesh = int(m.geom_dataid[g]) if m.geom_type[g] == MESH else -1
            if mesh >= 0:
                faces = m.mesh_face[m.mesh_faceadr[mesh] : m.mesh_faceadr[mesh] + m.mesh_facenum[mesh]]
                points = m.mesh_vert[m.mesh_vertadr[mesh] + faces].astype(float)
                corners.append(
                    np.stack([points[:, 0], points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]], axis=1)
                )
            first.append(first[-1] + (len(corners[-1]) if mesh >= 0 else 0))
        return [
            *(
                ints(f"ray_{name}", column)
                for name, column in zip(("site", "body", "spec", "at"), columns, strict=True)
            ),
            ints("ray_geom", self._geoms),
            ints("ray_geom_site", self._frames),
            ints("ray_geom_body", m.geom_bodyid[self._geoms]),
            ints("ray_kind", m.geom_type[self._geoms]),
            ints("ray_first", first),
            floats("ray_triangle", np.concatenate(corners) if corners else []),
        ]


def visible(m: mujoco.MjModel, geom: int) -> bool:
    """Return whether rays see a geom."""
    material = int(m.geom_matid[geom])
    return bool((m.mat_rgba[material] if material >= 0 else m.geom_rgba[geom])[3] != 0.0)


def triangles_of(m: mujoco.MjModel) -> int:
    """Triangles of all meshes that rays may meet."""
    return sum(
        int(m.mesh_facenum[m.geom_dataid[g]]) for g in range(m.ngeom) if m.geom_type[g] == MESH and visible(m, g)
    )


def unseen(m: mujoco.MjModel, n: int) -> str:
    """What a rangefinder lacks, empty if it is read."""
    if m.sensor_objtype[n] != int(mujoco.mjtObj.mjOBJ_SITE):
        return "rangefinder (of a camera)"
    if int(m.sensor_intprm[n, 0]) >> int(mujoco.mjtRayDataField.mjRAYDATA_NORMAL) & 1:
        return "rangefinder (normal)"
    if others := {int(m.geom_type[g]) for g in range(m.ngeom) if visible(m, g)} - {*SHAPES.values(), MESH}:
        names = ", ".join(sorted(mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower() for kind in others))
        return f"rangefinder (that sees {names})"
    return f"rangefinder (that sees more than {MOST_TRIANGLES} triangles)" if triangles_of(m) > MOST_TRIANGLES else ""
