# SPDX-License-Identifier: Apache-2.0
"""Limits of joints, tendons, controls and forces, of which files may say that there are none."""

from __future__ import annotations

import numpy as np

UNBOUNDED = 1e30
"""Limits from here on are none: files say infinity, or a number as large as they can."""

UNLIMITED = np.array([-UNBOUNDED, UNBOUNDED])


def within(limits: np.ndarray) -> np.ndarray:
    """Limits as numbers that single precision holds."""
    return np.clip(limits, -UNBOUNDED, UNBOUNDED)


def narrow(limits: np.ndarray, margin: float) -> bool:
    """Return whether both limits may hold at once: they are nearer than twice their margin."""
    return bool(np.ptp(within(limits)) < 2.0 * margin)


def bounds(limits: np.ndarray) -> bool:
    """Return whether a lower and an upper limit leave anything out."""
    return bool((np.abs(limits) < UNBOUNDED).any())
