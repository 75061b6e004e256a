# SPDX-License-Identifier: Apache-2.0
"""The command that is safe without a plan, as each drive is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from .layout import Layout


def safe_command(layout: Layout, joint_q: np.ndarray, joint_qd: np.ndarray, control_dt: float) -> np.ndarray:
    """The position given, a stop by the next control, or what holds the start, as the drive is ``[n, nu]``.

    The last is ``control_start``: the controls of an MJCF file's keyframe, else an equilibrium; zero where there is
    none. Limits are the caller's.

    Args:
        layout: State layout.
        joint_q: Joint coordinates ``[n, nq]`` [m, rad].
        joint_qd: Joint velocities ``[n, nv]`` [m/s, rad/s].
        control_dt: Time in which drives of accelerations come to a stop [s].
    """
    held, brake = layout.control_safe, layout.control_brake
    rest = layout.control_start if len(layout.control_start) else 0.0
    safe = np.where(held >= 0, joint_q[:, np.maximum(held, 0)], rest)
    return np.where(brake >= 0, -joint_qd[:, np.maximum(brake, 0)] / control_dt, safe)
