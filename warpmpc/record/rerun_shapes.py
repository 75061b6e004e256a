# SPDX-License-Identifier: Apache-2.0
"""The shapes of a scene as rerun draws them, and the paths of their entities."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
import trimesh

from .meshes import mesh_of
from .shapes import DEFAULT_COLOR, GROUND_COLOR

if TYPE_CHECKING:
    from ..model.heightfields import Surface
    from ..model.layout import Layout, ShapeInfo


def entity_path(*parts: str) -> str:
    """Entity path of these parts; a slash inside a part does not start a child."""
    return "/" + "/".join(rr.escape_entity_path_part(part) for part in parts)


def body_path(layout: Layout, body: int) -> str:
    """Entity path of a body, ``/scene/robot/link`` or ``/scene/object``; no body is the child of another."""
    owner = next((e.name for e in layout.entities if body in e.bodies), "")
    name = layout.body_name[body]
    link = name.removeprefix(f"{owner}/") if owner else name
    return entity_path("scene", owner, link) if owner and name != owner else entity_path("scene", name)


def draw_shape(
    recording: rr.RecordingStream, at: str, shape: ShapeInfo, layout: Layout, *, reach: float, opacity: float = 1.0
) -> None:
    """Log a shape once, for all times, as a child of the entity it is fixed to.

    Args:
        at: Entity path of the shape.
        reach: Half the edge of the square that stands for a plane [m].
        opacity: 1 is solid.
    """
    pose = rr.Transform3D(translation=shape.pose[:3], quaternion=shape.pose[3:])
    recording.log(at, pose, _geometry(shape, layout, reach, opacity), static=True)


def _geometry(shape: ShapeInfo, layout: Layout, reach: float, opacity: float) -> rr.AsComponents:
    a, b, _ = shape.scale
    ground = shape.kind == "plane" and shape.entity == "ground"
    color = [*(GROUND_COLOR if ground else shape.color or DEFAULT_COLOR), opacity]
    look = {
        "colors": [color],
        "fill_mode": rr.components.FillMode.Solid if opacity == 1.0 else "TransparentFillMajorWireframe",
    }
    match shape.kind:
        case "box":
            return rr.Boxes3D(half_sizes=[shape.scale], **look)
        case "sphere":
            return rr.Ellipsoids3D(half_sizes=[(a, a, a)], **look)
        case "ellipsoid":
            return rr.Ellipsoids3D(half_sizes=[shape.scale], **look)
        case "cylinder":
            return rr.Cylinders3D(lengths=[2.0 * b], radii=[a], **look)
        case "capsule":  # rerun's capsules start at their origin
            return rr.Capsules3D(lengths=[2.0 * b], radii=[a], translations=[(0.0, 0.0, -b)], **look)
        case "plane":
            points, triangles = _square(reach)
        case _:
            mesh = mesh_of(shape, layout)
            points, triangles = _square(0.0) if mesh is None else (mesh.vertices.astype(np.float32), mesh.faces)
    return _mesh(points, triangles, color)


def terrain(surface: Surface) -> rr.Mesh3D:
    """A heightfield as rerun draws it, in the world."""
    return _mesh(surface.points, surface.triangles, [*GROUND_COLOR, 1.0])


def _mesh(points: np.ndarray, triangles: np.ndarray, color: list[float]) -> rr.Mesh3D:
    normals = trimesh.Trimesh(points, triangles, process=False).vertex_normals.astype(np.float32)
    return rr.Mesh3D(vertex_positions=points, triangle_indices=triangles, vertex_normals=normals, albedo_factor=color)


def _square(reach: float) -> tuple[np.ndarray, np.ndarray]:
    """A square at z = 0, a little below, so that a grid drawn there stays visible."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=np.float32) * reach
    return np.column_stack([corners, np.full(4, -1e-3 * reach)]).astype(np.float32), np.array([[0, 1, 2], [0, 2, 3]])
