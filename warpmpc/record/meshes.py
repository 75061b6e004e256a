# SPDX-License-Identifier: Apache-2.0
"""Shapes of a scene as triangles."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import trimesh

if TYPE_CHECKING:
    from ..model.layout import Layout, ShapeInfo


def mesh_of(shape: ShapeInfo, layout: Layout, *, fine: bool = True) -> trimesh.Trimesh | None:
    """Mesh of a shape in its own frame [m], triangles counter-clockwise from outside; None without any.

    Args:
        shape: The shape; planes have none.
        fine: Whether round shapes have many triangles.
    """
    a, b, _ = shape.scale
    make, sides = trimesh.creation, 32 if fine else 24
    match shape.kind:
        case "mesh" if shape.mesh is not None:
            points, triangles = layout.meshes[shape.mesh]
            return trimesh.Trimesh(points * np.array(shape.scale), np.reshape(triangles, (-1, 3)), process=False)
        case "box":
            mesh = make.box(2.0 * np.array(shape.scale))
        case "sphere" | "ellipsoid":
            mesh = make.icosphere(3 if fine else 2, 1.0)
            mesh.apply_scale(a if shape.kind == "sphere" else shape.scale)
        case "cylinder":
            mesh = make.cylinder(a, 2.0 * b, sections=sides)
        case "capsule":
            mesh = make.capsule(2.0 * b, a, count=[24, 24] if fine else [12, 12])
        case "cone":
            mesh = make.cone(a, 2.0 * b, sections=sides)
        case _:
            return None
    mesh.apply_translation(-mesh.bounds.mean(axis=0))  # trimesh starts some at their foot
    return mesh
