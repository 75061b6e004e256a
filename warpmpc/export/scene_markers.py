# SPDX-License-Identifier: Apache-2.0
"""The shapes of a scene as markers that viewers of ROS messages draw."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..model.layout import IDENTITY, WORLD
from ..record.meshes import mesh_of
from ..record.shapes import DEFAULT_COLOR, shown_shapes
from . import ros_messages as ros

if TYPE_CHECKING:
    from ..model.layout import Layout, ShapeInfo

CUBE, SPHERE, CYLINDER, TRIANGLES = 1, 2, 3, 11
"""Types of ``visualization_msgs/Marker``."""
MOST_TRIANGLES = 500
"""Triangles of a mesh that is drawn as it is; of larger ones the convex hull is."""


def markers(layout: Layout) -> Any:
    """``visualization_msgs/MarkerArray`` of all shapes, each fixed to the frame of its body; planes are left out."""
    shapes = [shape for entity in layout.entities for shape in shown_shapes(layout, entity)]
    found = [_marker(shape, layout, i) for i, shape in enumerate(shapes) if shape.kind != "plane"]
    return ros.message("visualization_msgs/MarkerArray", markers=[marker for marker in found if marker is not None])


def _marker(shape: ShapeInfo, layout: Layout, number: int) -> Any:
    """Marker of a shape; None where a mesh is missing."""
    a, b, _ = shape.scale
    simple = {"box": (CUBE, shape.scale), "sphere": (SPHERE, (a, a, a))}
    simple |= {"ellipsoid": (SPHERE, shape.scale), "cylinder": (CYLINDER, (a, a, b))}
    points: list[Any] = []
    if shape.kind in simple:
        kind, half = simple[shape.kind]
    else:
        mesh = mesh_of(shape, layout, fine=False)
        if mesh is None:
            return None
        if len(mesh.faces) > MOST_TRIANGLES:
            mesh = mesh.convex_hull
        kind, half = TRIANGLES, (0.5, 0.5, 0.5)
        points = [ros.point(corner) for corner in mesh.triangles.reshape(-1, 3)]
    movable = shape.entity in layout.movable  # its frame is where the task puts it
    frame = shape.entity if movable else ros.WORLD_FRAME if shape.body == WORLD else layout.body_name[shape.body]
    return ros.marker(
        frame,
        IDENTITY if movable else shape.pose,
        kind=kind,
        scale=2.0 * np.array(half),
        color=shape.color or DEFAULT_COLOR,
        points=points,
        number=number,
    )
