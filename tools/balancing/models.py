# SPDX-License-Identifier: Apache-2.0
"""Which model of a ball on a moving tray predicts the plant best."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

import warpmpc

from .sight import GRAVITY, SHARE, Tray

if TYPE_CHECKING:
    from warpmpc import Scene

MODELS = {
    "g": (1.0, False, False),
    "g - a": (1.0, True, False),
    "5/7 g": (SHARE, False, False),
    "5/7 (g - a)": (SHARE, True, False),
    "5/7 (g - a), and the tray's turning": (SHARE, True, True),
}
"""Share of the acceleration, whether the tray's own counts, whether it turns."""
AMPLITUDES = (0.1, 0.2, 0.4)
"""Standard deviation of the joints' accelerations [rad/s²], in turn."""
AHEAD = 25
"""Controls that are predicted."""


def compare(scene: Scene, seeds: Sequence[int]) -> Iterator[dict[str, object]]:
    """Move the tray about at random and predict the ball from its true state, knowing how the tray moves.

    Args:
        scene: The scene.
        seeds: A run of 2.4 s each, several predictions a run, as long as the ball is on the tray.
    """
    error: dict[str, list[float]] = {name: [] for name in MODELS}
    way: list[float] = []
    tilt: list[float] = []
    for seed in seeds:
        motion = _Motion(*_recorded(scene, seed, AMPLITUDES[seed % len(AMPLITUDES)]), scene.timing.control_dt)
        for start in range(5, len(motion.place) - AHEAD - 2, 15):
            if not motion.on[start : start + AHEAD + 1].all():
                continue
            end = motion.place[start + AHEAD, :2]
            way.append(float(np.linalg.norm(end - motion.place[start, :2])))
            up = motion.turn[start : start + AHEAD].as_matrix()[:, 2, 2]
            tilt.append(float(np.degrees(np.arccos(np.clip(up, -1.0, 1.0))).max()))
            for name, model in MODELS.items():
                error[name].append(float(np.linalg.norm(motion.predicted(start, *model) - end)))
    yield {"predictions": len(way), "median_way_m": round(float(np.median(way)), 4), "largest_tilt_deg": max(tilt)}
    for name, values in error.items():
        middle, most = np.median(values), np.quantile(values, 0.9)
        yield {"model": name, "median_error_m": round(float(middle), 4), "90_percent_m": round(float(most), 4)}


def _recorded(scene: Scene, seed: int, amplitude: float) -> tuple[np.ndarray, np.ndarray]:
    """Poses of the tray and places of the ball in the world, after every control."""
    plant = warpmpc.Plant(scene, seed=seed)
    tray, count = Tray(plant), round(2.4 / scene.timing.control_dt)
    noise = gaussian_filter1d(np.random.default_rng(seed).normal(size=(count, plant.layout.nu)), 6, axis=0)
    poses, balls = [tray.pose()], [tray.centre()]
    for control in amplitude * noise / noise.std():
        plant.apply(control.astype(np.float32))
        poses.append(tray.pose())
        balls.append(tray.centre())
    return np.array(poses), np.array(balls)


class _Motion:
    """A recorded motion: the tray's, and the ball's in its frame."""

    def __init__(self, poses: np.ndarray, balls: np.ndarray, dt: float):
        self.dt, self.turn = dt, Rotation.from_quat(poses[:, 3:])
        self.place = self.turn.inv().apply(balls - poses[:, :3])
        self.velocity = np.gradient(self.place, dt, axis=0)
        self.acceleration = np.gradient(np.gradient(poses[:, :3], dt, axis=0), dt, axis=0)
        spin = (self.turn[1:] * self.turn[:-1].inv()).as_rotvec() / dt
        self.spin = np.vstack([spin, spin[-1:]])
        self.spin_rate = np.gradient(self.spin, dt, axis=0)
        height = np.median(self.place[:20, 2])
        self.on = np.abs(self.place[:, 2] - height) < 0.003

    def predicted(self, start: int, share: float, carried: bool, turning: bool) -> np.ndarray:
        """Place of the ball in x and y of the tray, :data:`AHEAD` controls after a start."""
        x, v = self.place[start, :2].copy(), self.velocity[start, :2].copy()
        for k in range(start + 1, start + AHEAD + 1):
            pull, turn, spin = GRAVITY.copy(), self.turn[k], self.spin[k]
            if carried:
                pull -= self.acceleration[k]
            if turning:
                away = turn.apply([*x, 0.0])
                pull -= np.cross(self.spin_rate[k], away) + np.cross(spin, np.cross(spin, away))
            rate = share * turn.inv().apply(pull)[:2]
            if turning:
                rate -= 2.0 * turn.inv().apply(np.cross(spin, turn.apply([*v, 0.0])))[:2]
            v += self.dt * rate
            x += self.dt * v
        return x
