# SPDX-License-Identifier: Apache-2.0
"""Arms of several makers, alone in a scene, and what is true of their shapes."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation
from small_scenes import layout_of, make_scene

from warpmpc import Scene
from warpmpc.scene.model.layout import Layout, ShapeInfo

DATA = "package://example-robot-data/robots"
ARMS = {
    "panda": "panda.urdf",
    "panda_meshes": f"{DATA}/panda_description/urdf/panda.urdf",
    "ur10": f"{DATA}/ur_description/urdf/ur10_robot.urdf",
    "kinova": f"{DATA}/kinova_description/robots/kinova.urdf",
    "mobile_panda": "mobile_panda.xml",
}
HOME = (0.0, -0.5, 0.0, -2.0, 0.0, 1.57, 0.78)
FOLDED = (0.0, 0.3, 0.0, -3.0, 0.0, 0.2, 0.78)
"""Postures of a Panda: the hand before it, and the hand in its shoulder."""


def arm_scene(name: str, **sections) -> Scene:
    """A scene with one of the arms, called ``arm``; keyword arguments replace whole sections."""
    arm = {"name": "arm", "asset": ARMS[name], "drive": {"damping": 10.0, "limit": 1.0}}
    if name in ("panda", "panda_meshes"):
        arm["joint_q"] = {f"panda_joint{i + 1}": q for i, q in enumerate(HOME)}
    data = {"robot": [arm], "ground": False, "goal": None, "cost": [{"term": "joint_velocity"}]}
    return make_scene(**{**data, "success": {"conditions": {"term": "joint_velocity", "below": 0.1}}, **sections})


def arm_layout(name: str) -> Layout:
    """The layout of one of the arms."""
    return layout_of(arm_scene(name))


def solid(layout: Layout, shape: ShapeInfo) -> trimesh.Trimesh:
    """A colliding shape as a convex mesh in its body's frame."""
    a, b, _ = shape.scale
    match shape.kind:
        case "box":
            mesh = trimesh.creation.box(2.0 * np.array(shape.scale))
        case "sphere":
            mesh = trimesh.creation.icosphere(3, radius=a)
        case "capsule":
            ball = trimesh.creation.icosphere(2, radius=a).vertices
            mesh = trimesh.convex.convex_hull(np.concatenate([ball + [0.0, 0.0, b], ball - [0.0, 0.0, b]]))
        case "cylinder":
            mesh = trimesh.creation.cylinder(radius=a, height=2.0 * b, sections=64)
        case "ellipsoid":
            mesh = trimesh.creation.icosphere(3).apply_scale(shape.scale)
        case _:
            mesh = trimesh.convex.convex_hull(layout.meshes[shape.mesh][0] * np.array(shape.scale))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(shape.pose[3:]).as_matrix(), shape.pose[:3]
    return mesh.apply_transform(pose)


def outside(mesh: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """Distance of points ``[n, 3]`` from a convex mesh, 0 inside."""
    planes = (mesh.triangles[:, 0] * mesh.face_normals).sum(axis=1)
    out = np.zeros(len(points))
    for i in np.flatnonzero((points @ mesh.face_normals.T - planes > 0.0).any(axis=1)):
        nearest = trimesh.triangles.closest_point(mesh.triangles, np.broadcast_to(points[i], (len(mesh.faces), 3)))
        out[i] = np.linalg.norm(nearest - points[i], axis=1).min()
    return out
