# SPDX-License-Identifier: Apache-2.0
"""Feet that are to be lifted in turn: heights that follow a clock."""

from typing import Annotated, Any

import warp as wp
from pydantic import Field

from ..cost.binding import Binding
from ..cost.keys import Frame, TermKeys
from ..cost.norms import NormKey, NormKind
from ..cost.residual import residual
from ..kernels.terms.points import Wanted, wanted
from ..kernels.terms.view import StepView, frame_position, step_time
from ..scene.types import Finite, Floats, NonNegative
from .residuals import Target


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


class Gait(TermKeys):
    """Feet that are lifted in turn."""

    feet: Annotated[tuple[Frame, ...], Field(min_length=1)]
    """Frames at the feet."""
    phases: Floats
    """When each foot is lifted, as a share of the cycle; (0, 0.5, 0.5, 0) is a trot of left and right foot in front,
    left and right behind."""
    cadence: NonNegative
    """Cycles in a second [1/s]."""
    swing: Annotated[float, Field(strict=True, gt=0.0, lt=1.0)] = 0.5
    """Share of the cycle that a foot is in the air."""
    height: Target
    """How high feet are lifted [m]: a number or the name of a scalar, one or one for each foot; 0 stands."""
    stand: Finite = 0.0
    """Height of the frames of feet that stand [m]: the feet's radius where the frames are in their middle."""
    norm: NormKey = NormKind.QUADRATIC
    """quadratic, or { kind, p, q }: l2, l22, cosh, power, smooth_abs, smooth_abs2, rectify."""

    derived = {"phase": wp.array[float], "wanted": Wanted, "numbers": int}

    def bind(self, p: Any, b: Binding) -> None:
        """Set the phase and the height of each foot [m]."""
        if len(self.phases) != len(self.feet):
            raise b.error(f"give one phase for each of the {len(self.feet)} feet", "phases", found=list(self.phases))
        p.phase, p.numbers = b.array(list(self.phases), dtype=float), len(self.feet)
        p.wanted = b.wanted(self.height, len(self.feet), key="height")


@residual("gait_residual", Gait)
def gait_residual(s: StepView, p: Gait.Params, i: int) -> float:
    """Norm of feet's heights less those of a gait: each foot is lifted in its turn, on level ground [m]."""
    lifted = wanted(s, p.wanted, i) * swing_height(p.cadence * step_time(s), p.phase[i], p.swing)
    return frame_position(s, p.feet[i])[2] - p.stand - lifted
