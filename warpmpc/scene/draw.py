# SPDX-License-Identifier: Apache-2.0
"""The task of an episode: goals, starts and obstacles drawn from a seed."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from .errors import SceneError, join_key
from .overrides import expand, split_key, with_values
from .schema import ShapeKind

if TYPE_CHECKING:
    from .schema import Draw, Obstacle, Rejection, Scene

TRIES = 1000
"""Draws before a task counts as impossible."""


def draw_task(scene: Scene, seed: int) -> tuple[Scene, dict[str, object]]:
    """Draw what ``randomize_task`` names, again and again until no place is too close to an obstacle.

    Args:
        scene: Scene to vary.
        seed: The same seed draws the same task.

    Returns:
        The drawn scene, and the drawn values by full key (``obstacle.wall.position``): one number, or a tuple.

    Raises:
        SceneError: If a thousand draws are all rejected.
    """
    ranges = _ranges(scene)
    turned = [phase.name for phase in scene.phase if phase.draw_rotation]
    if not ranges and not turned:
        return scene, {}
    rng = np.random.default_rng(seed)
    turns = np.random.default_rng((seed, len(turned)))  # of their own: what else is drawn stays as it was
    rotations = {join_key(("phase", name, "goal", "rotation")): _rotation(turns) for name in turned}
    for _ in range(TRIES):
        values = {key: _uniform(rng, draw) for key, draw in ranges.items()} | rotations
        drawn = with_values(scene, values)
        rejection = next((r for r in scene.randomize_task.reject if clearance(drawn, r) < r.clearance), None)
        if rejection is None:
            return drawn, values
    raise SceneError(
        f"{TRIES} draws of {', '.join(ranges)} all leave {rejection.place} closer than {rejection.clearance:g} m to an "
        "obstacle: widen the ranges or lower the clearance",
        key="randomize_task.draw",
        file=scene.path,
    )


def clearance(scene: Scene, rejection: Rejection) -> float:
    """Least distance of a place from the surfaces of the obstacles [m]; below zero inside one, meshes left out."""
    place = _place(scene, rejection)
    solid = [obstacle for obstacle in scene.obstacle if obstacle.shape is not ShapeKind.MESH]
    return min((signed_distance(obstacle, place) for obstacle in solid), default=math.inf)


def signed_distance(obstacle: Obstacle, point: tuple[float, ...]) -> float:
    """Distance of a point from an obstacle's surface [m], below zero inside; (x, y) lies at the obstacle's height."""
    point = (*point, obstacle.position[2]) if len(point) == 2 else point
    x, y, z = _into_frame([p - o for p, o in zip(point, obstacle.position, strict=True)], obstacle.rotation)
    size = obstacle.size or ()
    match obstacle.shape:
        case ShapeKind.SPHERE:
            return math.hypot(x, y, z) - size[0]
        case ShapeKind.BOX:
            return _beyond(abs(x) - size[0] / 2, abs(y) - size[1] / 2, abs(z) - size[2] / 2)
        case ShapeKind.CYLINDER:
            return _beyond(math.hypot(x, y) - size[0], abs(z) - size[1] / 2)
        case ShapeKind.CAPSULE:
            return math.hypot(x, y, max(abs(z) - size[1] / 2, 0.0)) - size[0]
        case ShapeKind.PLANE:
            return z
    raise ValueError(f"no distance to a {obstacle.shape}")


def _ranges(scene: Scene) -> dict[str, Draw]:
    """Full key → range, in the order of the keys, so that the order in the file does not matter."""
    data = scene.model_dump(mode="json")
    draws = scene.randomize_task.draw.items()
    return dict(sorted((join_key(key), draw) for text, draw in draws for key in expand(data, split_key(text))))


def _uniform(rng: np.random.Generator, draw: Draw) -> object:
    values = tuple(float(v) for v in rng.uniform(draw.low, draw.high))
    return values[0] if len(values) == 1 else values


def _rotation(rng: np.random.Generator) -> tuple[float, ...]:
    """A unit quaternion, of all orientations alike."""
    q = rng.normal(size=4)
    return tuple(float(x) for x in q / np.linalg.norm(q))


def _place(scene: Scene, rejection: Rejection) -> tuple[float, ...]:
    if rejection.at is not None:
        return rejection.at
    if rejection.place == "goal":
        return scene.goal.position
    entry = next(entry for entry in (*scene.object, *scene.robot) if entry.name == rejection.place)
    return entry.position or (0.0, 0.0, 0.0)


def _into_frame(v: list[float], q: tuple[float, ...]) -> tuple[float, float, float]:
    """Rotate a vector by the inverse of a unit quaternion (x, y, z, w): v + 2 w (v x u) + 2 (v x u) x u."""
    u, w = np.array(q[:3]), q[3]
    t = 2.0 * np.cross(v, u)
    return tuple(np.asarray(v) + w * t + np.cross(t, u))


def _beyond(*excess: float) -> float:
    """Distance from a box-like solid, given how far the point lies beyond each pair of its faces."""
    return math.hypot(*(max(e, 0.0) for e in excess)) + min(max(excess), 0.0)
