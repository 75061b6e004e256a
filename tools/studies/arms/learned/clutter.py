# SPDX-License-Identifier: Apache-2.0
"""Draws of a scene's obstacles: how far points are from them, and what the scene's camera shows of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from warpmpc.cost.resources.cloud import CloudVolume
from warpmpc.loop.plant.sensors import DepthCamera
from warpmpc.scene.draw import draw_task
from warpmpc.scene.errors import SceneError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from warpmpc import Scene
    from warpmpc.scene.schema_bodies import Cloud, Obstacle

GEOMS = {
    "box": (mujoco.mjtGeom.mjGEOM_BOX, lambda size: np.multiply(size, 0.5)),
    "cylinder": (mujoco.mjtGeom.mjGEOM_CYLINDER, lambda size: (size[0], 0.5 * size[1], 0.0)),
    "sphere": (mujoco.mjtGeom.mjGEOM_SPHERE, lambda size: (size[0], 0.0, 0.0)),
}
"""MuJoCo's kind and sizes of the shapes that clutter has."""


@dataclass(frozen=True)
class Clutter:
    """Obstacles, and the cloud that a camera sees of them."""

    obstacles: Sequence[Obstacle]
    cloud: Cloud
    seed: int

    @classmethod
    def drawn(cls, scene: Scene, seed: int) -> Clutter:
        """One draw of what ``randomize_task`` of a scene names.

        Raises:
            SceneError: If the scene has no cloud with a camera, or obstacles of other shapes.
        """
        cloud = next((cloud for cloud in scene.cloud if cloud.camera), None)
        if cloud is None:
            raise SceneError("needs a cloud with a camera", key="cloud", file=scene.path)
        for obstacle in scene.obstacle:
            if str(obstacle.shape) not in GEOMS:
                key = f"obstacle.{obstacle.name}.shape"
                raise SceneError("no such clutter", key=key, found=str(obstacle.shape), allowed=GEOMS)
        return cls(draw_task(scene, seed)[0].obstacle, cloud, seed)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distance from points ``[p, 3]`` to the nearest obstacle [m]."""
        out = np.full(len(points), np.inf)
        for obstacle in self.obstacles:
            d, size = points - np.array(obstacle.position), obstacle.size
            if str(obstacle.shape) == "sphere":
                out = np.minimum(out, np.sqrt((d * d).sum(axis=1)) - size[0])
                continue
            if obstacle.rotation != (0.0, 0.0, 0.0, 1.0):
                d = Rotation.from_quat(obstacle.rotation).inv().apply(d)
            if str(obstacle.shape) == "cylinder":
                d = np.column_stack([np.hypot(d[:, 0], d[:, 1]) - size[0], np.abs(d[:, 2]) - 0.5 * size[1]])
            else:
                d = np.abs(d) - 0.5 * np.array(size)
            outside = np.sqrt((np.maximum(d, 0.0) ** 2).sum(axis=1))
            out = np.minimum(out, outside + np.minimum(d.max(axis=1), 0.0))
        return out

    def seen(self) -> np.ndarray:
        """Points of one picture of the cloud's camera ``[p, 3]`` [m]."""
        spec = mujoco.MjSpec()
        for obstacle in self.obstacles:
            kind, size = GEOMS[str(obstacle.shape)]
            x, y, z, w = obstacle.rotation
            spec.worldbody.add_geom(type=kind, size=size(obstacle.size), pos=obstacle.position, quat=[w, x, y, z])
        return DepthCamera(self.cloud.camera, spec.compile(), [], seed=self.seed).points(0.0)

    def volume(self) -> SeenVolume:
        """The volume of distances that cost terms read."""
        work = CloudVolume(self.cloud, envs=1, device="cpu")
        work.show([self.seen()])
        work.upload()
        work.launch()
        return SeenVolume(work.distance[0], np.array(self.cloud.low), self.cloud.voxel)


@dataclass(frozen=True)
class SeenVolume:
    """Distances from a cloud, by voxel."""

    values: np.ndarray
    """``[nz, ny, nx]`` [m]."""
    low: np.ndarray
    """Lowest corner [m]."""
    voxel: float
    """[m]"""

    def at(self, points: np.ndarray) -> np.ndarray:
        """Distances of the voxels that points ``[..., 3]`` are in, as ``kernels.geometry.volume.voxel_distance``."""
        top = np.array(self.values.shape[::-1]) - 1e-3
        x, y, z = np.moveaxis(np.clip((points - self.low) / self.voxel, 0.0, top).astype(int), -1, 0)
        return self.values[z, y, x]
