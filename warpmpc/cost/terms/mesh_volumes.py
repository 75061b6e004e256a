# SPDX-License-Identifier: Apache-2.0
"""Signed distance volumes of meshes, computed once when a term is bound."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ...kernels.geometry.volume import MeshVolumes, mesh_distance_kernel

if TYPE_CHECKING:
    from collections.abc import Sequence

    import trimesh

    from ...scene.model.layout import ShapeInfo
    from ..binding import Binding

FINENESS = 32
"""Voxels along the longest side of a mesh, where nothing is said of them."""
FINEST = 0.01
"""Edge of a voxel at least, then [m]."""
LARGEST = 2**24
"""Voxels of a volume at most: 64 MB."""


def hull(shape: ShapeInfo, b: Binding) -> trimesh.Trimesh:
    """The convex hull of a mesh in its shape's frame, which is what physics collides with, too."""
    import trimesh

    points, _ = b.layout.meshes[shape.mesh]
    return trimesh.convex.convex_hull(points.astype(np.float64) * np.array(shape.scale))


def mesh_volumes(
    shapes: Sequence[ShapeInfo], reach: float, voxel: float | None, b: Binding
) -> tuple[MeshVolumes, list[int]]:
    """Volumes of the meshes among some shapes, and which one each shape has; -1 for what is no mesh.

    Args:
        shapes: Shapes; those of one mesh and size share a volume.
        reach: How far a volume goes beyond its mesh on every side [m].
        voxel: Edge of the voxels [m]; None for what :data:`FINENESS` says.
        b: The term being bound.

    Raises:
        SceneError: If a volume would be too large.
    """
    known: dict[tuple[bytes, tuple[float, ...]], int] = {}
    index, rows, grids, voxels = [], [], [], 0
    for shape in shapes:
        if shape.kind != "mesh":
            index.append(-1)
            continue
        key = (b.layout.meshes[shape.mesh][0].tobytes(), shape.scale)
        if key not in known:
            known[key] = len(rows)
            solid = hull(shape, b)
            edge = voxel or max(float(np.ptp(solid.vertices, axis=0).max()) / FINENESS, FINEST)
            low, high = solid.vertices.min(axis=0) - reach - edge, solid.vertices.max(axis=0) + reach + edge
            size = [math.ceil(side / edge) for side in high - low]
            if math.prod(size) > LARGEST:
                raise b.error(
                    f"the distance volume of a mesh would have {size} voxels: take larger ones",
                    "voxel",
                    found=f"{shape.entity}: {edge:g} m",
                )
            rows.append((voxels, low, edge, size))
            grids.append((solid, float(np.linalg.norm(high - low))))
            voxels += math.prod(size)
        index.append(known[key])
    out = MeshVolumes()
    out.reach = reach
    out.distance = wp.empty(voxels, dtype=float, device=b.device)
    out.first = b.array([first for first, *_ in rows], int)
    out.origin = b.array([low for _, low, *_ in rows], wp.vec3)
    out.voxel = b.array([edge for _, _, edge, _ in rows], float)
    out.size = b.array([size for *_, size in rows], wp.vec3i)
    for (first, low, edge, size), (solid, farthest) in zip(rows, grids, strict=True):
        mesh = wp.Mesh(points=b.array(solid.vertices, wp.vec3), indices=b.array(solid.faces.ravel(), int))
        where = [mesh.id, wp.vec3(*low), edge, wp.vec3i(*size), farthest, first]
        wp.launch(mesh_distance_kernel, math.prod(size), where, [out.distance], device=b.device)
        wp.synchronize_device(b.device)  # the mesh goes when this is done
    return out, index
