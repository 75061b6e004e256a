# SPDX-License-Identifier: Apache-2.0
"""The point clouds of a task: what is seen, for each environment its own."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..scene.schema_cloud import Cloud


class Clouds:
    """Points of every cloud of a scene, none at the start.

    Args:
        clouds: The scene's clouds.
        envs: Number of environments E.
    """

    def __init__(self, clouds: Sequence[Cloud], envs: int):
        self._capacity = {cloud.name: cloud.capacity for cloud in clouds}
        self._envs = envs
        self._nothing = np.zeros((0, 3), dtype=np.float32)
        self._points = {name: [self._nothing] * envs for name in self._capacity}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the clouds."""
        return tuple(self._capacity)

    def points(self, name: str, e: int = 0) -> np.ndarray:
        """Points of an environment ``[n, 3]`` [m], an array that nobody changes."""
        return self._points[name][e]

    def set(self, name: str, value: object, e: int | None = None) -> None:
        """Take a copy of points.

        Args:
            name: Cloud.
            value: Points ``[n, 3]``, or a list of them with one entry for each environment.
            e: Environment they belong to; all if None.

        Raises:
            ValueError: If they have the wrong shape or are more than the cloud has capacity for.
        """
        each = isinstance(value, list | tuple) and len(value) == self._envs and e is None and np.ndim(value[0]) == 2
        checked = [self._checked(name, v) for v in value] if each else [self._checked(name, value)] * self._envs
        for row in range(self._envs) if e is None else (e,):
            self._points[name][row] = checked[row]

    def reset(self, e: int) -> None:
        """Forget the points of an environment."""
        for rows in self._points.values():
            rows[e] = self._nothing

    def _checked(self, name: str, value: object) -> np.ndarray:
        try:
            points = np.array(value, dtype=np.float32, order="C")
        except (TypeError, ValueError):
            points = np.zeros(1, dtype=np.float32)
        if points.shape in ((0,), (0, 3)):
            return self._nothing
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"'{name}' is a cloud of points [n, 3], not {_shape(value)}")
        if len(points) > self._capacity[name]:
            raise ValueError(
                f"'{name}' has capacity for {self._capacity[name]} points, not for {len(points)}: "
                "give the scene's cloud a larger capacity"
            )
        return points


def _shape(value: object) -> str:
    """The shape of what is no cloud, in words."""
    try:
        return f"of shape {list(np.shape(value))}"
    except ValueError:
        return "rows of different lengths"
