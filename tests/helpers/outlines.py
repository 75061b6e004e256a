# SPDX-License-Identifier: Apache-2.0
"""Nearness of outlines seen from above in float64."""

import numpy as np
from rollouts import Rollouts, heading
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

RING = np.array([(np.cos(a), np.sin(a), 0.0) for a in np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)])
CORNERS = 0.5 * np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])


def seen_from_above(obstacle) -> np.ndarray:
    """Corners of an obstacle's outline, counter-clockwise, 32 or more for a round one, ``[n, 2]``."""
    turn, size = Rotation.from_quat(obstacle.rotation), obstacle.size
    if obstacle.shape == "box":
        points = turn.apply(CORNERS * size)
    elif obstacle.shape == "cylinder":
        points = turn.apply(np.concatenate([size[0] * RING + [0, 0, z * size[1]] for z in (-0.5, 0.5)]))
    else:
        half = size[1] / 2 if obstacle.shape == "capsule" else 0.0
        points = np.concatenate([size[0] * RING + turn.apply([0, 0, z]) for z in (-half, half)])
    points = points[:, :2] + obstacle.position[:2]
    return points[ConvexHull(points).vertices]


def gap(a: np.ndarray, b: np.ndarray) -> float:
    """Distance between two convex outlines, negative by their depth: of the origin from their Minkowski difference."""
    points = (b[:, None] - a).reshape(-1, 2)
    hull = ConvexHull(points)
    if (hull.equations[:, 2] < 0.0).all():
        return hull.equations[:, 2].max()
    corners = points[hull.vertices]
    edge = np.roll(corners, -1, axis=0) - corners
    part = np.clip(-(corners * edge).sum(-1) / (edge**2).sum(-1), 0.0, 1.0)
    return np.linalg.norm(corners + part[:, None] * edge, axis=1).min()


def outline_clearance(r: Rollouts, of: str, own: np.ndarray, within: float) -> np.ndarray:
    """Nearness of a body with its own corners ``[n, 2]`` to every obstacle but a plane."""
    position, turn = r.pose(of)
    obstacles = [seen_from_above(o) for o in r.scene.obstacle if o.shape != "plane"]
    total = []
    for at, yaw in zip(position.reshape(-1, 3)[:, :2], heading(turn), strict=True):
        c, s = np.cos(yaw), np.sin(yaw)
        body = at + own @ [[c, s], [-s, c]]
        total.append(sum(max(0.0, 1.0 - gap(body, obstacle) / within) for obstacle in obstacles))
    return r.each(total)
