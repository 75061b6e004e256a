# SPDX-License-Identifier: Apache-2.0
"""The term ``cloud_collision``: its keys in scene files, and how they become spheres and a volume."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Any

from ..kernels.terms import cloud
from ..scene.errors import SceneError
from ..scene.types import NonNegative, Positive, Section
from .collision import CollisionForm, Names, find_robots, moving_links, sphere_table
from .native import cloud as native
from .resources.cloud import PointClouds
from .term import CostTerm, parse_keys

if TYPE_CHECKING:
    from .binding import Binding


class Lookup(StrEnum):
    """Interpolation of distances in a volume."""

    NEAREST = "nearest"
    LINEAR = "linear"


class CloudCollision(Section):
    """Least distance of a robot's links, as spheres, from a point cloud: max(0, margin - d) [m], or 1 if d < margin."""

    cloud: str | None = None
    """Cloud of the scene; may be left out where there is but one."""
    of: str | None = None
    """Robot; all robots when left out."""
    links: Names | None = None
    """Links, ``robot/link`` or the link's own name; all that joints move when left out."""
    form: CollisionForm = CollisionForm.DISTANCE
    """distance: max(0, margin - d); binary: 1 if d < margin, else 0."""
    margin: NonNegative = 0.0
    """Points closer than this cost something [m]."""
    lookup: Lookup = Lookup.LINEAR
    """nearest: of the voxel a sphere's centre is in; linear: between the centres of eight, which is more exact."""
    allowance: NonNegative | None = None
    """How much nearer than the volume says points are taken to be [m]; half a voxel's diagonal when left out."""
    overhang: Positive = 0.03
    """How far the spheres may stick out of the links [m]: less takes more spheres."""


def _cloud_collision(keys: dict[str, Any], b: Binding) -> cloud.CloudCollisionParams:
    v = parse_keys(CloudCollision, keys, b)
    names = [c.name for c in b.scene.cloud]
    name = v.cloud or (names[0] if len(names) == 1 else None)
    if name not in names:
        what = "no such cloud" if name else "give it a [[cloud]] of the scene" if not names else "which cloud?"
        raise SceneError(what, key=f"{b.key}.cloud", file=b.file, found=name, allowed=names)
    robots = find_robots(v.of, b)
    p = cloud.CloudCollisionParams()
    p.spheres = sphere_table(robots, moving_links(robots, v.links, b), v.overhang, b)
    seen = b.resources.get(PointClouds).request(p, name)
    p.margin, p.binary = v.margin, int(v.form is CollisionForm.BINARY)
    p.between = int(v.lookup is Lookup.LINEAR)
    p.allowance = 0.5 * 3.0**0.5 * seen.voxel if v.allowance is None else v.allowance
    needed = v.margin + p.allowance + float(p.spheres.radius.numpy().max())
    if seen.reach < needed:
        raise SceneError(
            f"its reach is shorter than margin, allowance and the largest sphere's radius together, {needed:.3f} m",
            key=f"cloud.{name}.reach",
            file=b.file,
            found=seen.reach,
        )
    return p


TERMS = (
    CostTerm(
        "cloud_collision",
        cloud.cloud_collision,
        cloud.CloudCollisionParams,
        _cloud_collision,
        CloudCollision,
        native.cloud_collision,
    ),
)
