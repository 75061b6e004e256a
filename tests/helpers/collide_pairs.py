# SPDX-License-Identifier: Apache-2.0
"""Pairs of shapes that often touch."""

import numpy as np
from collide_world import Poses


def matrices(q: np.ndarray) -> np.ndarray:
    """Rotation matrices [N, 3, 3] of quaternions [N, 4] (w, x, y, z), normalized here."""
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    return np.stack([
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ], axis=1).reshape(-1, 3, 3)  # fmt: skip


def tilted(rng, n: int, angle) -> np.ndarray:
    """Rotations [N, 3, 3] by some angle [rad] about random axes."""
    axis = rng.normal(size=(n, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    half = 0.5 * np.broadcast_to(angle, n)[:, None]
    return matrices(np.concatenate([np.cos(half), axis * np.sin(half)], axis=1))


QUARTERS = np.array([
    [[s if j == p[i] else 0.0 for j in range(3)] for i, s in enumerate(signs)]
    for p in ((0, 1, 2), (1, 2, 0), (2, 0, 1), (0, 2, 1), (2, 1, 0), (1, 0, 2))
    for signs in np.array(np.meshgrid([1, -1], [1, -1], [1, -1])).T.reshape(-1, 3)
])  # fmt: skip
QUARTERS = QUARTERS[np.linalg.det(QUARTERS) > 0]
"""The 24 rotations that map axes to axes."""


def draw(family: str, n: int, seed: int = 0) -> Poses:
    """Pairs that often touch.

    Args:
        family: `any`: all directions and distances; `deep`: nearly the same centre; `unlike`: one is 10 to 50 times
            larger; `parallel`: axes along axes, as exact as floats are; `touching`: the same, a face of one at a face
            of the other; `stack`: the same with equal boxes, edges on edges; `nearly`: as `touching`, turned by 1e-4 to
            1e-2 rad; `slide`: turned about one common axis.
        n: How many.
        seed: Of the drawing.
    """
    rng = np.random.default_rng([seed, *family.encode()])
    size = rng.uniform(0.05, 0.4, (n, 2, 3))
    base = matrices(rng.normal(size=(n, 4)))
    away = rng.normal(size=(n, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    far = 2.4 * size.mean(axis=(1, 2))[:, None] * rng.uniform(0, 1, (n, 1))
    turn = matrices(rng.normal(size=(n, 4)))
    if family == "deep":
        far = 0.3 * far
    if family == "unlike":
        size[:, 1] *= rng.uniform(10, 50, (n, 1))
        far = 1.2 * size[:, 1].mean(axis=1)[:, None] * rng.uniform(0, 1, (n, 1))
    if family in ("parallel", "touching", "nearly", "slide", "stack"):
        turn = QUARTERS[rng.integers(24, size=n)]
        far = 1.5 * far
    if family == "slide":
        a = rng.uniform(-np.pi, np.pi, n)
        c, s, o, e = np.cos(a), np.sin(a), np.zeros(n), np.ones(n)
        turn = np.stack([c, -s, o, s, c, o, o, o, e], axis=1).reshape(n, 3, 3)
    if family == "nearly":
        turn = turn @ tilted(rng, n, 10 ** rng.uniform(-4, -2, n))
    local = away * far
    if family in ("touching", "nearly", "slide"):
        reach = size[:, 0] + np.einsum("nij,nj->ni", np.abs(turn), size[:, 1])
        k = rng.integers(3, size=n) if family != "slide" else np.full(n, 2)
        i = np.arange(n)
        local = rng.uniform(-0.7, 0.7, (n, 3)) * reach
        local[i, k] = rng.choice([-1, 1], n) * (reach[i, k] - rng.choice([1e-4, 1e-3, 1e-2], n))
    if family == "stack":
        turn = np.broadcast_to(np.eye(3), (n, 3, 3))
        size[:, 1] = size[:, 0]
        local = np.zeros((n, 3))
        local[np.arange(n), rng.integers(3, size=n)] = 1
        local *= 2 * size[:, 0] - rng.choice([1e-5, 1e-3], n)[:, None]
    origin = rng.uniform(-1, 1, (n, 3))
    pos = np.stack([origin, origin + np.einsum("nij,nj->ni", base, local)], axis=1)
    return Poses(pos, np.stack([base, base @ turn], axis=1).reshape(n, 2, 9), size)


POINTS = np.random.default_rng(3).normal(size=(24, 3))
POINTS = POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True) * (0.25, 0.2, 0.12)
POINTS = np.concatenate(
    [POINTS, [(0.1 * np.cos(a), 0.1 * np.sin(a), -0.15) for a in (0.0, 1.1, 1.5, 2.7, 3.9, 4.6, 5.8)]]
)
MESH = f'<mesh name="mesh" vertex="{" ".join(f"{x:.5f}" for x in POINTS.ravel())}"/>'
