# SPDX-License-Identifier: Apache-2.0
"""Feet that are to be lifted in turn: heights that follow a clock."""

import warp as wp

from .norms import Norm, norm_part, norm_total
from .residuals import Wanted, wanted
from .view import StepView, frame_position, step_time

wp.set_module_options({"enable_backward": False})


@wp.struct
class GaitParams:
    """Parameters of ``gait_residual``."""

    foot: wp.array[int]  # [n] frames
    phase: wp.array[float]  # [n] when each foot is lifted, as a share of the cycle
    cadence: float  # [1/s] cycles
    swing: float  # share of the cycle that a foot is in the air
    stand: float  # [m] height of the frames of feet that stand
    wanted: Wanted  # how high each foot is lifted [m]
    norm: Norm


@wp.func
def swing_height(cycles: float, phase: float, swing: float) -> float:
    """Height that a foot shall have at this time, as a share of its lift: a parabola, then zero.

    Args:
        cycles: Time in cycles.
        phase: Share of the cycle at which the foot is lifted.
        swing: Share of the cycle that it is in the air.
    """
    since = cycles - phase
    x = (since - wp.floor(since)) / swing
    return 4.0 * wp.max(x * (1.0 - x), 0.0)


@wp.func
def gait_component(s: StepView, p: GaitParams, i: int) -> float:
    """Height of foot i above the one that it shall have now [m]."""
    lifted = wanted(s, p.wanted, i) * swing_height(p.cadence * step_time(s), p.phase[i], p.swing)
    return frame_position(s, p.foot[i])[2] - p.stand - lifted


@wp.func
def gait_residual(s: StepView, p: GaitParams) -> float:
    """Norm of feet's heights less those of a gait: each foot is lifted in its turn, on level ground [m]."""
    total = float(0.0)
    for i in range(p.foot.shape[0]):
        total += norm_part(gait_component(s, p, i), p.norm)
    return norm_total(total, p.norm)
