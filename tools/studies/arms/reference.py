# SPDX-License-Identifier: Apache-2.0
"""Least times: from the arm's start to rest in a posture, within limits of velocity and acceleration alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from .arm import Arm


@dataclass(frozen=True)
class Way:
    """A way of the joints, sampled control by control."""

    q: np.ndarray
    """``[n, joints]`` [rad]"""
    qd: np.ndarray
    """``[n, joints]`` [rad/s]"""
    duration: float
    """[s]"""


def fastest(arm: Arm, acceleration: float, postures: list[np.ndarray]) -> float:
    """Least time from the start to rest in any of some postures [s]: no obstacle, no other limit."""
    return min(quickest(arm, acceleration, arm.start[arm.dofs], q, dt=None).duration for q in postures)


def quickest(arm: Arm, acceleration: float, start: np.ndarray, end: np.ndarray, *, dt: float | None) -> Way:
    """The quickest way from rest to rest, by ruckig (Berscheid and Kröger 2021).

    Args:
        arm: The arm.
        acceleration: Greatest acceleration [rad/s²].
        start: Posture ``[n]``.
        end: Posture ``[n]``.
        dt: Time between two samples [s]; None for the duration alone.

    Raises:
        ValueError: If ruckig is not installed or finds no way.
    """
    try:
        import ruckig
    except ImportError:
        raise ValueError("least times need ruckig: pip install ruckig") from None
    count = len(start)
    wanted = ruckig.InputParameter(count)
    wanted.current_position, wanted.target_position = start.tolist(), end.tolist()
    wanted.current_velocity = wanted.target_velocity = [0.0] * count
    wanted.current_acceleration = wanted.target_acceleration = [0.0] * count
    wanted.max_velocity, wanted.max_acceleration = arm.speed.tolist(), [acceleration] * count
    wanted.max_jerk = [float("inf")] * count
    way = ruckig.Trajectory(count)
    if ruckig.Ruckig(count).calculate(wanted, way) < 0:
        raise ValueError("ruckig found no way")
    if dt is None:
        return Way(np.zeros((0, count)), np.zeros((0, count)), way.duration)
    samples = [way.at_time(min(t, way.duration))[:2] for t in np.arange(dt, way.duration + dt, dt)]
    q, qd = (np.array(values) for values in zip(*samples, strict=True))
    return Way(q, qd, way.duration)
