# SPDX-License-Identifier: Apache-2.0
"""Conditions on frames, joints and cost terms, looked at on the host in one state of one world."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from ..errors import SceneError
from ..model.layout import WORLD
from .goal import Comparison, angle_between, heading_between

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ..model.layout import Layout
    from ..schema import Condition, Scene
    from .task import Task


@dataclass(frozen=True)
class StateSnapshot:
    """State of a plant as conditions see it."""

    body_q: np.ndarray  # [nb, 7] poses of all bodies
    joint_q: np.ndarray  # [nq]
    terms: Mapping[str, float]
    """Values of the cost terms that conditions name, without their weights; empty before the first control."""
    poses: Mapping[str, np.ndarray] = field(default_factory=dict)
    """True poses ``[7]`` of what moves by itself, where the task has what was seen of it."""

    def pose(self, name: str, task: Task, e: int) -> np.ndarray:
        """True pose of one of the task's poses ``[7]``."""
        return self.poses[name] if name in self.poses else task.pose(name, e)


class Conditions:
    """Conditions that must all hold.

    Args:
        conditions: What the scene says.
        layout: The scene's layout, targets included.
        task: Where targets are.
        e: Environment of the task.
        scene: The scene, for errors.
        key: Key of the conditions in the scene, for errors.
    """

    def __init__(self, conditions: Sequence[Condition], layout: Layout, task: Task, e: int, *, scene: Scene, key: str):
        self._layout, self._task, self._e, self._flat = layout, task, e, scene.flat_poses
        self._rows = []
        for i, condition in enumerate(conditions):
            where = f"{key}.{i}" if len(conditions) > 1 else key
            self._rows.append((condition, *self._find(condition, scene, where)))

    def _find(self, condition: Condition, scene: Scene, key: str) -> tuple[int, int]:
        try:
            if condition.frame is not None:
                compared = any(v is not None for v in (condition.distance, condition.yaw, condition.rotation))
                other = self._layout.frame(condition.to, key=f"{key}.to") if compared else -1
                return self._layout.frame(condition.frame, key=f"{key}.frame"), other
            if condition.joint is not None:
                return self._layout.joint(condition.joint, key=f"{key}.joint"), -1
        except SceneError as error:
            error.file = scene.path
            raise
        if condition.term not in scene.cost_labels:
            raise SceneError(
                "no such cost term",
                key=f"{key}.term",
                file=scene.path,
                found=condition.term,
                allowed=scene.cost_labels,
            )
        return -1, -1

    def hold(self, snapshot: StateSnapshot) -> bool:
        """Return whether all of them hold."""
        return all(comparison.holds for comparison in self.compared(snapshot))

    def compared(self, snapshot: StateSnapshot) -> Iterator[Comparison]:
        """Compare what each condition is about with its bounds."""
        for condition, index, other in self._rows:
            if condition.term is not None:
                name, value = condition.term, snapshot.terms.get(condition.term, np.nan)
            elif condition.joint is not None:
                name, value = condition.joint, float(snapshot.joint_q[index])
            else:
                pose = self.frame_pose(snapshot, index)
                name, value = f"height of {condition.frame}", float(pose[2])
                if other >= 0:
                    yield from self._near(condition, pose, self.frame_pose(snapshot, other))
            if condition.above is not None:
                yield Comparison(name, value, condition.above, above=True)
            if condition.below is not None:
                yield Comparison(name, value, condition.below)

    def _near(self, condition: Condition, pose: np.ndarray, target: np.ndarray) -> Iterator[Comparison]:
        pair, axes = f"{condition.frame} to {condition.to}", 2 if condition.to in self._flat else 3
        if condition.distance is not None:
            yield Comparison(
                f"distance of {pair} [m]", float(np.linalg.norm((pose - target)[:axes])), condition.distance
            )
        if condition.yaw is not None:
            yield Comparison(f"heading of {pair} [rad]", heading_between(pose[3:], target[3:]), condition.yaw)
        if condition.rotation is not None:
            yield Comparison(f"rotation of {pair} [rad]", angle_between(pose[3:], target[3:]), condition.rotation)

    def frame_pose(self, snapshot: StateSnapshot, frame: int) -> np.ndarray:
        """World pose ``[7]`` of a frame."""
        body, local = int(self._layout.frame_body[frame]), self._layout.frame_pose[frame]
        if body == WORLD:
            return local
        origin = (
            snapshot.body_q[body] if body >= 0 else snapshot.pose(self._task.pose_name[-2 - body], self._task, self._e)
        )
        return chained(origin, local)


def chained(pose: np.ndarray, local: np.ndarray) -> np.ndarray:
    """World pose ``[7]`` of a pose relative to another; in plain numbers, which cost less than small arrays."""
    px, py, pz, x, y, z, w = pose.tolist()
    lx, ly, lz, a, b, c, d = local.tolist()
    tx, ty, tz = 2.0 * (y * lz - z * ly), 2.0 * (z * lx - x * lz), 2.0 * (x * ly - y * lx)
    return np.array(
        [
            px + lx + w * tx + y * tz - z * ty,
            py + ly + w * ty + z * tx - x * tz,
            pz + lz + w * tz + x * ty - y * tx,
            w * a + x * d + y * c - z * b,
            w * b + y * d + z * a - x * c,
            w * c + z * d + x * b - y * a,
            w * d - x * a - y * b - z * c,
        ]
    )
