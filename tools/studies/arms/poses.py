# SPDX-License-Identifier: Apache-2.0
"""Poses that an arm can reach: its tool's in random postures that touch nothing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from .arm import Arm

SHRINK = 0.1
"""Share of each joint's range that is left out at both ends."""
CLEARANCE = 0.02
"""Space around the links in the posture that a pose is drawn from [m]."""


@dataclass(frozen=True)
class Reachable:
    """A pose and a posture that has it."""

    pose: np.ndarray
    """(x, y, z, qx, qy, qz, qw) ``[7]``."""
    posture: np.ndarray
    """Driven joints ``[n]``."""


def draw_pose(arm: Arm, seed: int, *, clearance: float = CLEARANCE) -> Reachable:
    """A random reachable pose; the same seed draws the same one.

    Args:
        arm: The arm.
        seed: Seed of the pose.
        clearance: Space around the links that the posture has, to each other and to obstacles [m].
    """
    rng = np.random.default_rng([seed, 2])
    margin = SHRINK * (arm.upper - arm.lower)
    while True:
        q = rng.uniform(arm.lower + margin, arm.upper - margin)
        if not arm.touching(q, margin=clearance):
            return Reachable(arm.tool(q), q)
