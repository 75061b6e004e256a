# SPDX-License-Identifier: Apache-2.0
"""Expectation of a plan: the rollout of one of its samples, as host arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ...scene.model.layout import GOAL, WORLD

if TYPE_CHECKING:
    from ...scene.model.layout import Layout


@dataclass(frozen=True)
class Rollout:
    """States and controls of one sample over the horizon; slice 0 is the observed state.

    Copies: later plans do not change them.
    """

    times: np.ndarray
    """When each state is, on the clock of the observations ``[T+1]`` [s]."""
    joint_q: np.ndarray
    """Joint coordinates ``[T+1, nq]`` [m, rad]."""
    joint_qd: np.ndarray
    """Joint velocities ``[T+1, nv]`` [m/s, rad/s]."""
    body_q: np.ndarray
    """Poses of the bodies (x, y, z, qx, qy, qz, qw) ``[T+1, nb, 7]``, named by ``Controller.layout.body_name``."""
    control: np.ndarray
    """Control of every step ``[T, nu]``, named by ``Controller.layout.control_name``."""
    knots: np.ndarray
    """Spline control points that the controls come from ``[P, nu]``."""
    cost: float
    """Cost of the sample; infinite where it diverged."""
    layout: Layout
    """Names and places of joints, bodies and frames."""

    def frame(self, name: str) -> np.ndarray:
        """Poses of a frame (``robot/frame``, ``robot/link``, an object) ``[T+1, 7]``.

        Raises:
            SceneError: If there is no such frame.
            ValueError: If it is one of the task's poses: those are in ``Controller.task``.
        """
        index = self.layout.frame(name)
        body, local = int(self.layout.frame_body[index]), self.layout.frame_pose[index]
        if body <= GOAL:
            raise ValueError(f"'{name}' is a pose of the task, which stands still in a rollout: task['{name}']")
        if body == WORLD:
            return np.tile(local, (len(self.body_q), 1))
        poses = [wp.transform(*pose) * wp.transform(*local) for pose in self.body_q[:, body]]
        return np.array([[*pose.p, *pose.q] for pose in poses], dtype=np.float32)
