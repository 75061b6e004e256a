# SPDX-License-Identifier: Apache-2.0
"""The cost term of a gait: how its keys in scene files become kernel parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from ..kernels.terms import gait as costs
from ..scene.errors import SceneError
from ..scene.types import Finite, Floats, NonNegative, Section
from .norms import NormKey, NormKind
from .residual_keys import Wanted
from .term import CostTerm, Residual, parse_keys
from .wanted import wanted

if TYPE_CHECKING:
    from .binding import Binding


class Gait(Section):
    """Feet that are lifted in turn."""

    feet: Annotated[tuple[str, ...], Field(min_length=1)]
    """Frames at the feet."""
    phases: Floats
    """When each foot is lifted, as a share of the cycle; (0, 0.5, 0.5, 0) is a trot of left and right foot in front,
    left and right behind."""
    cadence: NonNegative
    """Cycles in a second [1/s]."""
    swing: Annotated[float, Field(strict=True, gt=0.0, lt=1.0)] = 0.5
    """Share of the cycle that a foot is in the air."""
    height: Wanted
    """How high feet are lifted [m]: a number or the name of a scalar, one or one for each foot; 0 stands."""
    stand: Finite = 0.0
    """Height of the frames of feet that stand [m]: the feet's radius where the frames are in their middle."""
    norm: NormKey = NormKind.QUADRATIC
    """quadratic, or { kind, p, q }: l2, l22, cosh, power, smooth_abs, smooth_abs2, rectify."""


def _gait(keys: dict[str, Any], b: Binding) -> costs.GaitParams:
    v = parse_keys(Gait, keys, b)
    if len(v.phases) != len(v.feet):
        raise SceneError(
            f"give one phase for each of the {len(v.feet)} feet",
            key=f"{b.key}.phases",
            file=b.file,
            found=list(v.phases),
        )
    p = costs.GaitParams()
    p.foot = b.array([b.frame(foot, "feet") for foot in v.feet], dtype=int)
    p.phase, p.wanted = b.array(list(v.phases), dtype=float), wanted(v.height, len(v.feet), b, key="height")
    p.cadence, p.swing, p.stand, p.norm = v.cadence, v.swing, v.stand, v.norm.struct()
    return p


TERMS = (
    CostTerm(
        "gait_residual",
        costs.gait_residual,
        costs.GaitParams,
        _gait,
        Gait,
        residual=Residual(costs.gait_component, lambda p: p.foot.shape[0]),
    ),
)
"""Cost terms of gaits."""
