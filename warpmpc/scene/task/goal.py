# SPDX-License-Identifier: Apache-2.0
"""The goal of a scene: its pose, and how far a frame is from it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ..schema import Goal, Pose, Scene, Success

GOAL = "goal"
"""Name of the goal among a task's poses."""


def goal_pose(scene: Scene, pose: Pose | None = None) -> np.ndarray:
    """Pose ``[7]`` of a scene's goal; without a height it lies at its target's start height.

    Args:
        scene: The scene; without a goal the pose is the origin, which is not used.
        pose: Where the goal is instead, in a later phase.
    """
    if scene.goal is None:
        return np.array([0.0] * 6 + [1.0], dtype=np.float32)
    heights = {item.name: item.position[2] for item in scene.object}
    return target_pose(pose or scene.goal, height=heights.get(scene.goal.target, 0.0))


def target_pose(pose: Pose, *, height: float = 0.0) -> np.ndarray:
    """Pose ``[7]`` that a scene file describes.

    Args:
        pose: Position, heading or rotation.
        height: Its height when it has none [m].
    """
    position = [*pose.position, height][:3]
    if pose.rotation is not None:
        rotation = list(pose.rotation)
    else:
        half = 0.5 * (pose.yaw or 0.0)
        rotation = [0.0, 0.0, math.sin(half), math.cos(half)]
    return np.array(position + rotation, dtype=np.float32)


def heading(q: np.ndarray) -> float:
    """Heading about z of a quaternion (x, y, z, w) [rad]."""
    x, y, z, w = (float(c) for c in q)
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


@dataclass(frozen=True)
class Comparison:
    """A number that success, a failure or a phase looks at, and its bound."""

    name: str
    value: float
    bound: float
    above: bool = False
    """True where the value must be at least the bound; else at most."""

    @property
    def holds(self) -> bool:
        """Return whether the value is within its bound; NaN never is."""
        return self.value >= self.bound if self.above else self.value <= self.bound

    @property
    def excess(self) -> float:
        """Distance of the value beyond its bound; at most zero where it is within."""
        return self.bound - self.value if self.above else self.value - self.bound


@dataclass(frozen=True)
class GoalError:
    """Distance of a frame from the goal."""

    axes: np.ndarray
    """Error along each compared axis, ``[2]`` or ``[3]`` [m]."""
    yaw: float
    """Heading error in [0, π] [rad]."""
    rotation: float
    """Rotation angle in [0, π] [rad]."""

    @property
    def position(self) -> float:
        """Euclidean error [m]."""
        return float(np.linalg.norm(self.axes))

    def within(self, success: Success) -> bool:
        """Return whether every error that counts is within its tolerance."""
        return all(comparison.holds for comparison in self.compared(success))

    def compared(self, success: Success) -> Iterator[Comparison]:
        """Compare every error that counts with its tolerance."""
        if success.position is not None:
            limits = np.broadcast_to(success.position, self.axes.shape)
            for axis, error, most in zip("xyz", np.abs(self.axes), limits, strict=False):
                yield Comparison(f"error along {axis} [m]", float(error), float(most))
        for name, value, most in (
            ("distance to the goal [m]", self.position, success.distance),
            ("heading error [rad]", self.yaw, success.yaw),
            ("rotation to the goal [rad]", self.rotation, success.rotation),
        ):
            if most is not None:
                yield Comparison(name, value, most)

    def worst_axis(self, success: Success) -> float | None:
        """Error along the axis that is farthest from its tolerance [m]; None where axes have none."""
        if success.position is None:
            return None
        error = np.abs(self.axes)
        return float(error[np.argmax(error / success.position)])


def heading_between(a: np.ndarray, b: np.ndarray) -> float:
    """Difference of the headings of two quaternions, in [0, π] [rad]."""
    return abs((heading(a) - heading(b) + math.pi) % (2.0 * math.pi) - math.pi)


def angle_between(a: np.ndarray, b: np.ndarray) -> float:
    """Angle between two orientations, in [0, π] [rad]."""
    return 2.0 * math.acos(min(1.0, abs(float(np.dot(a, b)))))


def goal_error(goal: Goal, goal_at: np.ndarray, pose: np.ndarray) -> GoalError:
    """Error of a pose ``[7]`` against the goal's pose ``[7]``; heights count when the goal has one."""
    axes = (pose - goal_at)[: len(goal.position)].astype(np.float64)
    return GoalError(axes, heading_between(pose[3:], goal_at[3:]), angle_between(pose[3:], goal_at[3:]))
