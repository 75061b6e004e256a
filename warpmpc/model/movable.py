# SPDX-License-Identifier: Apache-2.0
"""Obstacles that the task moves, as mocap bodies of a MuJoCo model."""

from __future__ import annotations

from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np
import warp as wp

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .layout import Layout


def movable_body(name: str) -> str:
    """Name of the mocap body that a movable obstacle is."""
    return f"movable/{name}"


def start_poses(layout: Layout) -> np.ndarray:
    """Poses of the movable obstacles at the start ``[n, 7]``."""
    poses = [layout.shapes[entity.shapes[0]].pose for entity in layout.entities if entity.movable]
    return np.array(poses, dtype=np.float32).reshape(-1, 7)


def with_movable(mjcf: str, layout: Layout, geoms: Sequence[str]) -> str:
    """An MJCF model whose movable obstacles are mocap bodies.

    Args:
        mjcf: The model, in which they are geoms of the world.
        layout: Layout of what is in it.
        geoms: Geom of each of the layout's shapes.
    """
    if not layout.movable:
        return mjcf
    root = ElementTree.fromstring(mjcf)
    world = root.find("worldbody")
    for name, pose in zip(layout.movable, start_poses(layout), strict=True):
        geom = next(g for g in world.iter("geom") if g.get("name") == geoms[layout.entity(name).shapes[0]])
        world.remove(geom)
        at = wp.transform(*pose)
        local = wp.transform_inverse(at) * wp.transform(
            wp.vec3(*_numbers(geom, "pos", (0.0, 0.0, 0.0))), _rotation(geom)
        )
        body = ElementTree.SubElement(world, "body", {"name": movable_body(name), "mocap": "true", **_pose(at)})
        geom.attrib.update(_pose(local))
        body.append(geom)
    return ElementTree.tostring(root, encoding="unicode")


def _numbers(geom: ElementTree.Element, key: str, default: Sequence[float]) -> list[float]:
    return [float(x) for x in geom.get(key).split()] if key in geom.attrib else list(default)


def _rotation(geom: ElementTree.Element) -> wp.quat:
    w, x, y, z = _numbers(geom, "quat", (1.0, 0.0, 0.0, 0.0))
    return wp.normalize(wp.quat(x, y, z, w))


def _pose(at: wp.transform) -> dict[str, str]:
    x, y, z, w = at.q
    return {"pos": " ".join(map(repr, map(float, at.p))), "quat": " ".join(repr(float(c)) for c in (w, x, y, z))}
