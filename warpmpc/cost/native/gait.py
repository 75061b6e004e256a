# SPDX-License-Identifier: Apache-2.0
"""Baked source of gaits."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ...bake.lines import Operand
from .norms import norm
from .residuals import wanted

if TYPE_CHECKING:
    from ..code.state import TermCode


def gait(code: TermCode, p: Any) -> Operand:
    """``gait.gait_residual``."""
    lines, params = code.lines, code.params
    cycles = lines.let(f"(T)({params}.cadence * (((const float*)s.start.data)[e] + s.step_end.data[at + 1]))")
    residual = []
    for i, foot in enumerate(p.foot.numpy()):
        since = lines.let(f"{cycles} - {params}.phase.data[{i}]")
        x = lines.let(f"({since} - VFLOOR({since})) / {params}.swing")
        lifted = lines.let(f"4.0f * VMAX({x} * (1.0f - {x}), 0.0f)")
        height = code.state.frame(int(foot)).position[2]
        residual.append(lines.sum(height, (-1.0, f"{params}.stand"), (lines.let(f"-{lifted}"), wanted(code, p, i))))
    return norm(code, residual, p)
