# SPDX-License-Identifier: Apache-2.0
"""Signed distance volumes of closed convex meshes, computed once."""

import warp as wp

from .volume import eight_voxels, inside_volume

wp.set_module_options({"enable_backward": False})


@wp.struct
class MeshVolumes:
    """Signed distances around meshes, one volume after the other, each in its mesh's own frame."""

    distance: wp.array[float]  # of the voxels' centres, x fastest [m]
    first: wp.array[int]  # [meshes] where a volume begins
    origin: wp.array[wp.vec3]  # [meshes] lowest corner [m]
    voxel: wp.array[float]  # [meshes] [m]
    size: wp.array[wp.vec3i]  # [meshes] voxels along x, y, z
    reach: float  # from a mesh to the sides of its volume at least, besides one voxel [m]


@wp.kernel
def mesh_distance_kernel(
    # inputs
    mesh: wp.uint64,
    origin: wp.vec3,
    voxel: float,
    size: wp.vec3i,
    farthest: float,
    first: int,
    # outputs
    distance: wp.array[float],
):
    """One thread: signed distance of the centre of one voxel from a mesh, negative inside."""
    i = wp.tid()
    x = i % size[0]
    y = (i // size[0]) % size[1]
    z = i // (size[0] * size[1])
    at = origin + voxel * wp.vec3(float(x) + 0.5, float(y) + 0.5, float(z) + 0.5)
    found = wp.mesh_query_point_sign_normal(mesh, at, farthest)
    nearest = wp.mesh_eval_position(mesh, found.face, found.u, found.v)
    distance[first + i] = found.sign * wp.length(at - nearest)


@wp.func
def mesh_distance(p: MeshVolumes, k: int, at: wp.vec3) -> float:
    """Signed distance of a point in a mesh's frame [m]; outside its volume a bound below it.

    The volume is convex and has the mesh in it: a point x outside and the point c of the volume nearest to it have
    (x - c)·(m - c) ≤ 0 for all m of the mesh, so that d(x)² ≥ ‖x - c‖² + d(c)².
    """
    size = p.size[k]
    cells = (at - p.origin[k]) / p.voxel[k]
    g = inside_volume(cells, size[0], size[1], size[2])
    d = eight_voxels(p.distance, p.first[k], size[0], size[1], g)
    away = p.voxel[k] * (cells - wp.vec3(0.5, 0.5, 0.5) - g)
    beyond = wp.dot(away, away)
    if beyond > 0.0:
        return wp.sqrt(d * d + beyond)
    return d
