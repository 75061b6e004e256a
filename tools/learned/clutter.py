# SPDX-License-Identifier: Apache-2.0
"""Random clutter on a table, what a depth camera sees of it, and a volume of distances from what was seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

LOW, HIGH = np.array([0.2, -0.5, -0.1]), np.array([0.9, 0.5, 0.7])
"""Where there may be something [m]."""
_FAR = 3.0
"""Rays that meet nothing end here [m]."""


@dataclass(frozen=True)
class Clutter:
    """Upright boxes and cylinders, and balls."""

    kind: np.ndarray  # [n] 0 box, 1 cylinder, 2 ball
    centre: np.ndarray  # [n, 3] [m]
    yaw: np.ndarray  # [n] [rad]
    size: np.ndarray  # [n, 3] half extents; radius, radius, half height [m]

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Clutter:
        """A table with 4 to 12 things on it, some of them on others."""
        count = int(rng.integers(4, 13))
        kind = rng.integers(0, 3, count)
        size = rng.uniform(0.02, 0.09, (count, 3))
        size[:, 2] = rng.uniform(0.03, 0.16, count)
        size[kind == 1, 1] = size[kind == 1, 0]
        size[kind == 2] = size[kind == 2, :1]
        at = rng.uniform([0.35, -0.35], [0.75, 0.35], (count, 2))
        shelf = rng.uniform(size=count) < 0.2
        height = size[:, 2] + np.where(shelf, rng.uniform(0.1, 0.3, count), 0.0)
        table = np.array([0.55, 0.0, -0.05]), np.array([0.35, 0.5, 0.05])
        return cls(
            np.concatenate([[0], kind]),
            np.concatenate([table[0][None], np.column_stack([at, height])]),
            np.concatenate([[0.0], rng.uniform(-np.pi, np.pi, count)]),
            np.concatenate([table[1][None], size]),
        )

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distance from points ``[p, 3]`` to the nearest thing [m]."""
        out = np.full(len(points), np.inf)
        for kind, centre, yaw, size in zip(self.kind, self.centre, self.yaw, self.size, strict=True):
            d = points - centre
            if kind == 2:
                out = np.minimum(out, np.sqrt((d**2).sum(axis=1)) - size[0])
                continue
            if kind == 1:
                q = np.column_stack([np.hypot(d[:, 0], d[:, 1]) - size[0], np.abs(d[:, 2]) - size[2]])
            else:
                c, s = np.cos(yaw), np.sin(yaw)
                local = np.column_stack([c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0], d[:, 2]])
                q = np.abs(local) - size
            outer = np.sqrt((np.maximum(q, 0.0) ** 2).sum(axis=1))
            out = np.minimum(out, outer + np.minimum(q.max(axis=1), 0.0))
        return out

    def seen(self, rng: np.random.Generator, *, width: int = 128, noise: float = 0.003) -> np.ndarray:
        """The cloud of one depth image ``[p, 3]`` [m], from a drawn place on one side.

        Args:
            rng: Draws the place and the noise.
            width: Pixels from left to right, three quarters of it from top to bottom.
            noise: Standard deviation of the depth [m].
        """
        turn, target = rng.uniform(-np.pi, np.pi), np.array([0.55, 0.0, 0.1])
        away = rng.uniform(0.9, 1.3)
        rise = rng.uniform(0.35, 0.9)
        eye = target + away * np.array([np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)])
        forward = (target - eye) / away
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        x, y = np.meshgrid(np.linspace(-0.6, 0.6, width), np.linspace(-0.45, 0.45, 3 * width // 4))
        ray = forward + x.reshape(-1, 1) * right + y.reshape(-1, 1) * np.cross(right, forward)
        ray /= np.linalg.norm(ray, axis=1)[:, None]
        depth, live = np.zeros(len(ray)), np.ones(len(ray), dtype=bool)
        for _ in range(80):
            d = self.distance(eye + depth[live, None] * ray[live])
            depth[live] += d
            live[live] = (d > 1e-4) & (depth[live] < _FAR)
            if not live.any():
                break
        depth += rng.normal(0.0, noise, len(depth))
        points = (eye + depth[:, None] * ray)[depth < _FAR - 1.0]
        return points[((points > LOW) & (points < HIGH)).all(axis=1)]


@dataclass(frozen=True)
class Volume:
    """Distances from a cloud at the corners of a grid."""

    values: np.ndarray  # [x, y, z] [m]
    cell: float

    @classmethod
    def of(cls, cloud: np.ndarray, cell: float) -> Volume:
        """Distances up to 20 cm on a grid of cells of this size [m]."""
        axes = [np.arange(a, b + cell, cell) for a, b in zip(LOW, HIGH, strict=True)]
        at = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        distance, _ = cKDTree(cloud).query(at.reshape(-1, 3), distance_upper_bound=0.2)
        return cls(np.minimum(distance, 0.2).reshape(at.shape[:3]).astype(np.float32), cell)

    def at(self, points: np.ndarray) -> np.ndarray:
        """Distances at points ``[..., 3]``, between the eight corners around each [m]."""
        place = np.clip((points - LOW) / self.cell, 0.0, np.array(self.values.shape) - 1.001)
        corner = place.astype(np.int32)
        share = (place - corner).astype(np.float32)
        ny, nz = self.values.shape[1:]
        first, flat = (corner[..., 0] * ny + corner[..., 1]) * nz + corner[..., 2], self.values.ravel()
        edges = {}
        for x in (0, 1):
            for y in (0, 1):
                start = first + (x * ny + y) * nz
                edges[x, y] = flat[start] + share[..., 2] * (flat[start + 1] - flat[start])
        sides = [edges[x, 0] + share[..., 1] * (edges[x, 1] - edges[x, 0]) for x in (0, 1)]
        return sides[0] + share[..., 0] * (sides[1] - sides[0])


def drawn_poses(count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Positions ``[n, 3]`` and rotations ``[n, 3, 3]`` of a link among the clutter."""
    at = rng.uniform([0.3, -0.4, 0.0], [0.8, 0.4, 0.5], (count, 3))
    return at, Rotation.random(count, random_state=int(rng.integers(2**31))).as_matrix()
