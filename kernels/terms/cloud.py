# SPDX-License-Identifier: Apache-2.0
"""Collision of a robot's links, as spheres, with a point cloud through its distance volume."""

import warp as wp

from ..geometry.volume import Volume, between_voxels, voxel_distance
from .collision import SphereTable
from .view import StepView

wp.set_module_options({"enable_backward": False})


@wp.struct
class CloudCollisionParams:
    """Parameters of ``cloud_collision``."""

    spheres: SphereTable
    volume: Volume
    margin: float  # [m]
    allowance: float  # how much nearer things are taken to be than the volume says [m]
    between: int  # 1 between the centres of eight voxels, 0 at the nearest one
    binary: int  # 1 below the margin instead of how far below it


@wp.func
def cloud_distance(p: CloudCollisionParams, e: int, at: wp.vec3) -> float:
    """Distance of a point from the cloud [m]."""
    if p.between != 0:
        return between_voxels(p.volume, e, at) - p.allowance
    return voxel_distance(p.volume, e, at) - p.allowance


@wp.func
def cloud_collision(s: StepView, p: CloudCollisionParams) -> float:
    """max(0, margin - d), d the least distance of a link's spheres from the cloud [m]; or 1 if d < margin, else 0.

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
