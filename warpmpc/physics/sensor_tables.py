# SPDX-License-Identifier: Apache-2.0
"""Tables of the contacts that sensors look at (``native/sense.h``).

Tables of rays from sites, and of the geoms that they may meet (``native/rays.h``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from .base import BOX, CAPSULE, CYLINDER, ELLIPSOID, HFIELD, MESH, PLANE, SPHERE
from .collisions import seen_geoms
from .frames import FrameTables
from .runtime.bake import Lines, Vector, text
from .source_parts import floats, ints

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from .frames import Sites
    from .model import PhysicsModel

_OBJECT = mujoco.mjtObj


class ContactSensors(FrameTables):
    """Which pairs of geoms count for a sensor, and with which sign."""

    def __init__(self, model: PhysicsModel, sites: Sites):
        super().__init__(model, sites)
        self._signs: list[list[float]] = []
        self._zones: list[np.ndarray] = []

    def tables(self) -> list[str]:
        """Definitions of the tables."""
        if not self._signs:
            return []
        return [
            floats("sensor_sign", self._signs),
            floats("sensor_zone", self._zones or [np.zeros(3)]),
            floats("pair_rank", self._ranks()),
        ]

    def _sign(self, of: Callable[[tuple[int, int]], float]) -> str:
        """Signs of all pairs, as a function of their bodies or geoms."""
        self._signs.append([float(of(pair.geoms)) for pair in self.model.pairs] or [0.0])
        return f"sensor_sign + {len(self._signs) - 1} * PAIRS"

    def _zone(self, site: int) -> tuple[int, str]:
        """Frame and size of a site."""
        m = self.mj
        self._zones.append(m.site_size[site])
        frame = self.frame(m.site_bodyid[site], m.site_pos[site], m.site_quat[site])
        return frame, f"{int(m.site_type[site])}, sensor_zone + {3 * len(self._zones) - 3}"

    def _bodies(self, geoms: tuple[int, int]) -> tuple[int, int]:
        return int(self.mj.geom_bodyid[geoms[0]]), int(self.mj.geom_bodyid[geoms[1]])

    def on(self, lines: Lines, bodies: Sequence[int], about: Vector, name: str) -> list[tuple[Vector, Vector]]:
        """Force of contacts on some bodies, and its torque about a point.

        Args:
            lines: Takes the statements.
            bodies: The bodies.
            about: The point.
            name: Of a new variable.
        """
        if not self.model.pairs:
            return []

        def side(geoms: tuple[int, int]) -> float:
            first, second = (float(body in bodies) for body in self._bodies(geoms))
            return second - first

        point = ", ".join(text(x) for x in about)
        lines.add(f"T {name}[6]; contact_wrench(w, {self._sign(side)}, V3{{{point}}}, {name});")
        return [([f"{name}[{k}]" for k in range(3)], [f"{name}[{k}]" for k in range(3, 6)])]

    def touch(self, n: int) -> str:
        """Reading of a touch sensor."""
        site = int(self.mj.sensor_objid[n])
        body, (frame, zone) = int(self.mj.site_bodyid[site]), self._zone(site)

        def side(geoms: tuple[int, int]) -> float:
            first, second = self._bodies(geoms)
            return -1.0 if second == body else 1.0 if first == body else 0.0

        return f"touch(w, {self._sign(side)}, {zone}, w.site_at[{frame}], w.site_turn[{frame}])"

    def tell(self, n: int, at: int) -> str:
        """Statement that reads a sensor of contacts.

        Args:
            n: The sensor.
            at: First of its readings.
        """
        m = self.mj
        ends = [(int(m.sensor_objtype[n]), int(m.sensor_objid[n])), (int(m.sensor_reftype[n]), int(m.sensor_refid[n]))]
        frame, zone = -1, f"{int(mujoco.mjtGeom.mjGEOM_SPHERE)}, sensor_zone"
        if ends[0][0] == int(_OBJECT.mjOBJ_SITE):
            frame, zone = self._zone(ends[0][1])
        spec, reduce, slots = contact_fields(m, n)
        sign = self._sign(lambda geoms: self._matches(geoms, *ends))
        return f"tell_contacts(w, {sign}, pair_rank, {frame}, {zone}, {spec}, {reduce}, {slots}, w.sensed + {at});"

    def _matches(self, geoms: tuple[int, int], first: tuple[int, int], second: tuple[int, int]) -> float:
        """1 where a pair is of a sensor's two objects, -1 where it is with its geoms exchanged, else 0."""
        sides = [[self._is(g, end) for g in geoms] for end in (first, second)]
        if not all(any(side) for side in sides):
            return 0.0
        nothing = int(_OBJECT.mjOBJ_UNKNOWN)
        if first[0] != nothing and second[0] != nothing:
            return 1.0 if sides[0][0] and sides[1][1] else -1.0 if sides[0][1] and sides[1][0] else 0.0
        if first[0] != nothing:
            return 1.0 if sides[0][0] else -1.0
        return 1.0 if second[0] == nothing or sides[1][1] else -1.0

    def _is(self, geom: int, end: tuple[int, int]) -> bool:
        """Whether a geom belongs to an object."""
        kind, number = end
        body = int(self.mj.geom_bodyid[geom])
        if kind == int(_OBJECT.mjOBJ_GEOM):
            return geom == number
        if kind == int(_OBJECT.mjOBJ_BODY):
            return body == number
        return kind != int(_OBJECT.mjOBJ_XBODY) or body in self.model.subtree(number)

    def _ranks(self) -> list[int]:
        """Place of each pair in the order in which MuJoCo finds contacts."""
        m, keys = self.mj, []
        told = [tuple(sorted((int(a), int(b)))) for a, b in zip(m.pair_geom1, m.pair_geom2, strict=True)]
        for pair in self.model.pairs:
            bodies, both = tuple(sorted(self._bodies(pair.geoms))), tuple(sorted(pair.geoms))
            tree = not self.model.off("MIDPHASE") and all(m.body_bvhadr[body] >= 0 for body in bodies)
            within = told.index(both) - len(told) if both in told else 0
            by_body = tuple(sorted(pair.geoms, key=lambda g: (int(m.geom_bodyid[g]), g)))
            keys.append((bodies, within, pair.geoms if tree else by_body))
        order = sorted(range(len(keys)), key=keys.__getitem__)
        return np.argsort(order).tolist() or [0]


def contact_fields(m: mujoco.MjModel, n: int) -> tuple[int, int, int]:
    """Fields of a sensor of contacts as bits, how it reduces them, and its slots."""
    spec, reduce = (int(x) for x in m.sensor_intprm[n, :2])
    sizes = (1, 3, 3, 1, 3, 3, 3, 3, 3)
    width = sum(size for k, size in enumerate(sizes) if spec >> k & 1)
    return spec, reduce, int(m.sensor_dim[n]) // width


def untold(m: mujoco.MjModel, n: int) -> str:
    """What is not told of a sensor of contacts, empty if all is."""
    spec, reduce, _ = contact_fields(m, n)
    if spec >> int(mujoco.mjtConDataField.mjCONDATA_LINVEL):
        return "contact (linvel, angvel)"
    if m.geom_gap.any() or m.pair_gap.any():
        return "contact (of geoms with a gap)"
    flat = np.count_nonzero(~np.isin(m.geom_type, (SPHERE, ELLIPSOID)))
    return "contact (several of two geoms in their order)" if not reduce and spec > 1 and flat > 1 else ""


SHAPES = {
    "PLANE": PLANE,
    "SPHERE": SPHERE,
    "CAPSULE": CAPSULE,
    "ELLIPSOID": ELLIPSOID,
    "CYLINDER": CYLINDER,
    "BOX": BOX,
    "HFIELD": HFIELD,
}
"""Shapes that rays meet, besides meshes."""
_NORMAL = int(mujoco.mjtRayDataField.mjRAYDATA_NORMAL)
MOST_TRIANGLES = 5000
"""Triangles of all meshes that rays may meet."""


class Rays(FrameTables):
    """Rays along the z axes of sites."""

    def __init__(self, model: PhysicsModel, sites: Sites):
        super().__init__(model, sites)
        self._rays: list[tuple[int, int, int, int]] = []

    def add(self, n: int, at: int) -> None:
        """Take a rangefinder on.

        Args:
            n: The sensor.
            at: First of its readings.
        """
        m, site = self.mj, int(self.mj.sensor_objid[n])
        frame = self.frame(int(m.site_bodyid[site]), m.site_pos[site], m.site_quat[site])
        self._rays.append((frame, int(m.site_bodyid[site]), int(m.sensor_intprm[n, 0]), at))
        if len(self._rays) == 1:
            self._geoms = sorted(seen_geoms(m))
            self._frames = [self.frame(int(m.geom_bodyid[g]), m.geom_pos[g], m.geom_quat[g]) for g in self._geoms]

    @property
    def sizes(self) -> dict[str, int]:
        """Macros of the source."""
        m, geoms = self.mj, self._geoms if self._rays else []
        return {
            **{f"RAY_{name}": kind for name, kind in SHAPES.items()},
            "RAYS": len(self._rays),
            "RAY_GEOMS": len(geoms),
            "RAY_TRIANGLES": triangles_of(m) if self._rays else 0,
            "RAY_FIELDS": int(np.count_nonzero(m.geom_type[geoms] == HFIELD)),
            "RAY_NORMALS": int(any(spec >> _NORMAL & 1 for _, _, spec, _ in self._rays)),
        }

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


def triangles_of(m: mujoco.MjModel) -> int:
    """Triangles of all meshes that rays may meet."""
    return sum(int(m.mesh_facenum[m.geom_dataid[g]]) for g in seen_geoms(m) if m.geom_type[g] == MESH)


def unseen(m: mujoco.MjModel, n: int) -> str:
    """What a rangefinder lacks, empty if it is read."""
    if m.sensor_objtype[n] != int(mujoco.mjtObj.mjOBJ_SITE):
        return "rangefinder (of a camera)"
    if others := {int(m.geom_type[g]) for g in seen_geoms(m)} - {*SHAPES.values(), MESH}:
        names = ", ".join(sorted(mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower() for kind in others))
        return f"rangefinder (that sees {names})"
    return f"rangefinder (that sees more than {MOST_TRIANGLES} triangles)" if triangles_of(m) > MOST_TRIANGLES else ""
