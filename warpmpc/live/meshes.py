# SPDX-License-Identifier: Apache-2.0
"""Shapes of a scene as triangles."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import trimesh

if TYPE_CHECKING:
    from ..model.layout import Layout, ShapeInfo


def mesh_of(shape: ShapeInfo, layout: Layout) -> tuple[np.ndarray, np.ndarray] | None:
    """Points ``[n, 3]`` and triangles ``[m, 3]`` of a shape in its own frame; None where there is nothing to draw."""
    a, b, _ = shape.scale
    make = trimesh.creation
    match shape.kind:
        case "mesh":
            if shape.mesh is None:
                return None
            points, triangles = layout.meshes[shape.mesh]
            return (points * np.array(shape.scale)).astype(np.float32), np.asarray(triangles).reshape(-1, 3)
        case "box":
            mesh = make.box(2.0 * np.array(shape.scale))
        case "sphere":
            mesh = make.icosphere(3, a)
        case "ellipsoid":
            mesh = make.icosphere(3, 1.0)
            mesh.apply_scale(shape.scale)
        case "cylinder":
            mesh = make.cylinder(a, 2.0 * b, sections=32)
        case "capsule":
            mesh = make.capsule(2.0 * b, a, count=[24, 24])
        case "cone":
            mesh = make.cone(a, 2.0 * b, sections=32)
        case _:
            return None
    points = np.array(mesh.vertices)
    points -= 0.5 * (points.min(axis=0) + points.max(axis=0))  # trimesh starts some at their foot
    return points.astype(np.float32), np.array(mesh.faces)
