# SPDX-License-Identifier: Apache-2.0
"""A ball on a tray as a camera shows it: late, with noise, and filtered."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from warpmpc import Plant, State

GRAVITY = np.array([0.0, 0.0, -9.81])
SHARE = 5.0 / 7.0
"""Of the acceleration that a frictionless point would have, for a solid ball."""
SLACK = 1e-6
"""What a lapse of time may lack [s]: times are sums of steps."""


class Tray:
    """Where tray and ball of a plant are.

    Args:
        plant: A plant with the frame ``panda/tray`` and the object ``ball``.
    """

    def __init__(self, plant: Plant):
        self.plant, layout = plant, plant.layout
        self._tray, self._ball = (int(layout.frame_body[layout.frame(name)]) for name in ("panda/tray", "ball"))
        joint = int(np.flatnonzero(layout.joint_child == self._ball)[0])
        self.q, self.qd = int(layout.joint_q_start[joint]), int(layout.joint_qd_start[joint])
        """First joint coordinate and velocity of the ball."""

    def pose(self) -> np.ndarray:
        """Pose of the tray ``[7]``."""
        return self.plant.body_q[self._tray].astype(float)

    def centre(self) -> np.ndarray:
        """Place of the ball in the world ``[3]`` [m]."""
        return self.plant.body_q[self._ball, :3].astype(float)

    def ball(self) -> np.ndarray:
        """Place of the ball in the tray's frame ``[3]`` [m]."""
        pose = self.pose()
        return Rotation.from_quat(pose[3:]).inv().apply(self.centre() - pose[:3])


class Sight:
    """Observes the ball and estimates where it is and how fast, in the tray's frame.

    A Kalman filter for x and one for y, whose input is (5/7) (Rᵀ(g - a))_xy, R and a of the tray.

    Args:
        tray: Tray and ball.
        dt: Length of a control [s].
        rate: Observations a second.
        noise: Standard deviation of every coordinate [m].
        seed: Seed of that noise.
        unknown: Standard deviation of what accelerates the ball besides, over a control [m/s²].
    """

    def __init__(self, tray: Tray, dt: float, *, rate: float, noise: float, seed: int, unknown: float = 0.3):
        self._tray, self._dt, self._rate, self._noise = tray, dt, rate, noise
        self._rng, self._frame = np.random.default_rng([seed, 4]), -1
        self._move = np.array([[1.0, dt], [0.0, 1.0]])
        push = np.array([0.5 * dt * dt, dt])
        self._process, self._push = unknown**2 * np.outer(push, push), push
        self._x: np.ndarray | None = None  # place and velocity [2, 2], a column for each axis
        self._spread = np.diag([noise**2, 0.05**2])
        self._last: tuple[np.ndarray, np.ndarray] | None = None  # place and velocity of the tray [m, m/s]

    def __call__(self, time: float, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Joint coordinates and velocities with the estimated ball in place of the true one.

        Args:
            time: The time [s].
            state: The true state.
        """
        pose = self._tray.pose()
        turn, before = Rotation.from_quat(pose[3:]), self._last
        velocity = np.zeros(3) if before is None else (pose[:3] - before[0]) / self._dt
        if self._x is not None and before is not None:
            acceleration = (velocity - before[1]) / self._dt
            pull = SHARE * turn.inv().apply(GRAVITY - acceleration)[:2]
            self._x = self._move @ self._x + np.outer(self._push, pull)
            self._spread = self._move @ self._spread @ self._move.T + self._process
        self._last = pose[:3], velocity
        if (frame := int((time + SLACK) * self._rate)) > self._frame:
            self._frame = frame
            seen = self._tray.centre() + self._rng.normal(0.0, self._noise, 3)
            self._correct(turn.inv().apply(seen - pose[:3])[:2])
        return self._written(state, pose, turn, velocity)

    def _correct(self, seen: np.ndarray) -> None:
        if self._x is None:
            self._x = np.array([seen, np.zeros(2)])
            return
        gain = self._spread[:, 0] / (self._spread[0, 0] + self._noise**2)
        self._x = self._x + np.outer(gain, seen - self._x[0])
        self._spread = self._spread - np.outer(gain, self._spread[0])

    def _written(
        self, state: State, pose: np.ndarray, turn: Rotation, velocity: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        q, qd, tray = state.joint_q.copy(), state.joint_qd.copy(), self._tray
        height = tray.plant.layout.shapes[tray.plant.layout.entity("ball").shapes[0]].scale[0]
        q[tray.q : tray.q + 3] = pose[:3] + turn.apply([*self._x[0], height])
        qd[tray.qd : tray.qd + 3] = velocity + turn.apply([*self._x[1], 0.0])
        return q, qd
