# SPDX-License-Identifier: Apache-2.0
"""Collision of a robot's links, as spheres, with a point cloud through its distance volume."""

from enum import StrEnum
from typing import Any

import warp as wp

from ...kernels.cost.view import StepView
from ...kernels.geometry.volume import Volume, between_voxels, voxel_distance
from ...scene.errors import SceneError
from ...scene.types import NonNegative
from ..binding import Binding
from ..code import collision as source
from ..keys import term
from ..resources.cloud import PointClouds
from .spheres import LinkKeys


class Lookup(StrEnum):
    """Interpolation of distances in a volume."""

    NEAREST = "nearest"
    LINEAR = "linear"


def cloud_name(b: Binding, name: str | None) -> str:
    """Name of the cloud that a key ``cloud`` means, the only one when it is None."""
    names = [c.name for c in b.scene.cloud]
    name = name or (names[0] if len(names) == 1 else None)
    if name not in names:
        what = "no such cloud" if name else "give it a [[cloud]] of the scene" if not names else "which cloud?"
        raise b.error(what, "cloud", found=name, allowed=names)
    return name


class CloudCollision(LinkKeys):
    """Least distance of a robot's links, as spheres, from a point cloud: max(0, margin - d) [m], or 1 if d < margin."""

    cloud: str | None = None
    """Cloud of the scene; may be left out where there is but one."""
    lookup: Lookup = Lookup.LINEAR
    """nearest: of the voxel a sphere's centre is in; linear: between the centres of eight, which is more exact."""
    allowance: NonNegative | None = None
    """How much nearer than the volume says points are taken to be [m]; half a voxel's diagonal when left out."""

    derived = LinkKeys.derived | {"volume": Volume, "allowance": float, "between": int}

    def bind(self, p: Any, b: Binding) -> None:
        """Find spheres of links, and the cloud's volume."""
        name = cloud_name(b, self.cloud)
        super().bind(p, b)
        seen = b.resources.get(PointClouds).request(p, name)
        p.between = int(self.lookup is Lookup.LINEAR)
        p.allowance = 0.5 * 3.0**0.5 * seen.voxel if self.allowance is None else self.allowance
        needed = self.margin + p.allowance + float(p.spheres.radius.numpy().max())
        if seen.reach < needed:
            raise SceneError(
                f"its reach is shorter than margin, allowance and the largest sphere's radius together, {needed:.3f} m",
                key=f"cloud.{name}.reach",
                file=b.file,
                found=seen.reach,
            )


@wp.func
def cloud_distance(p: CloudCollision.Params, e: int, at: wp.vec3) -> float:
    """Distance of a point from the cloud [m]."""
    if p.between != 0:
        return between_voxels(p.volume, e, at) - p.allowance
    return voxel_distance(p.volume, e, at) - p.allowance


@term("cloud_collision", CloudCollision, source=source.cloud_collision)
def cloud_collision(s: StepView, p: CloudCollision.Params) -> float:
    """Nearness of links to a point cloud, max(0, margin - d), d least of their spheres [m]; or 1 if d < margin.

    The second is the binary cost of Bhardwaj et al. 2021, Eq. 11, with distances in place of its learned checker.
    """
    least = p.margin
    for g in range(p.spheres.body.shape[0]):
        pose = s.body_q[s.t, s.w, p.spheres.body[g]]
        for i in range(p.spheres.first[g], p.spheres.first[g] + p.spheres.count[g]):
            at = wp.transform_point(pose, p.spheres.centre[i])
            least = wp.min(least, cloud_distance(p, s.e, at) - p.spheres.radius[i])
    if p.binary != 0:
        return wp.where(least < p.margin, 1.0, 0.0)
    return p.margin - least
