# SPDX-License-Identifier: Apache-2.0
"""Depth cameras of simulated plants: rays against the plant's own geometry become points in the world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import mujoco
import numpy as np

if TYPE_CHECKING:
    from ..scene.schema import Camera


class DepthCamera:
    """One camera in one world of MuJoCo, a ray for every pixel.

    Where a pixel shows the robot it keeps what it showed last, as perception with a filter for the robot does: what
    the arm hides does not vanish.

    Args:
        camera: What the scene says of it.
        model: Model of the world.
        robot: Geoms of the robots.
        seed: Seed of its noise.
    """

    def __init__(self, camera: Camera, model: mujoco.MjModel, robot: Sequence[int], *, seed: int):
        self.camera, self.model, self.data = camera, model, mujoco.MjData(model)
        self._robot = np.zeros(model.ngeom + 1, dtype=bool)  # the last one is no geom at all
        self._robot[list(robot)] = True
        self._ray = pixel_rays(camera)
        self._eye = np.array(camera.position, dtype=float)
        self._geom = np.zeros(len(self._ray), dtype=np.int32)
        self._depth = np.zeros(len(self._ray))
        self._seed = seed
        self.reset()

    def reset(self) -> None:
        """Forget every picture."""
        self._kept = np.full(len(self._ray), np.nan)
        self._rng = np.random.default_rng([self._seed, 2])
        self.pictures = 0

    def due(self, time: float) -> bool:
        """Return whether it is time for the next picture [s]."""
        return time * self.camera.rate >= self.pictures - 1e-6

    def points(self, time: float) -> np.ndarray:
        """Take a picture of :attr:`data` and return all points that are known ``[n, 3]`` [m].

        Args:
            time: When it is taken [s].
        """
        self.pictures = int(time * self.camera.rate + 1e-6) + 1
        mujoco.mj_kinematics(self.model, self.data)
        count, rays = len(self._ray), self._ray.ravel()
        found = (self._geom, self._depth, None, count, self.camera.far)
        mujoco.mj_multiRay(self.model, self.data, self._eye, rays, None, 1, -1, *found)
        seen = ~self._robot[self._geom]
        depth = np.where(self._geom >= 0, self._depth, np.nan)  # nothing there
        if self.camera.noise:
            depth = depth + self._rng.normal(0.0, self.camera.noise, count)
        self._kept[seen] = depth[seen]
        known = np.isfinite(self._kept)
        return (self._eye + self._kept[known, None] * self._ray[known]).astype(np.float32)


def pixel_rays(camera: Camera) -> np.ndarray:
    """Unit vectors from the camera through its pixels, row by row from the upper left ``[n, 3]``."""
    ahead = np.subtract(camera.look_at, camera.position)
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, ahead)
    half = np.tan(np.radians(0.5 * camera.fov))
    y = half * (1.0 - 2.0 * (np.arange(camera.height) + 0.5) / camera.height)
    x = half * camera.width / camera.height * (2.0 * (np.arange(camera.width) + 0.5) / camera.width - 1.0)
    rays = ahead + x[None, :, None] * right + y[:, None, None] * up
    rays = rays.reshape(-1, 3)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)
