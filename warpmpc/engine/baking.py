# SPDX-License-Identifier: Apache-2.0
"""Which of a scene's cost terms become part of an engine's source."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..bake.lines import Lines, OutOfRange
from ..bake.state import NotBaked, TermCode
from ..bake.terms import TermSource
from ..cost.term import CostTerm

if TYPE_CHECKING:
    from ..bake.state import StateCode
    from ..cost.stack import CostStack


def bake(costs: CostStack, state: StateCode, *, stage_risk: float = 0.0) -> tuple[tuple[TermSource, ...], list[int]]:
    """Source of all terms that can be written, and the numbers of those that cannot.

    Args:
        costs: The terms.
        state: What they may ask about a state, in which they leave what they share.
        stage_risk: R of ρ(l; R), which needs all terms of a step together: none is written where it is not zero.
    """
    baked, staged = [], []
    for i, (term, bound) in enumerate(costs.terms):
        code = TermCode(state, Lines(f"t{i}_"), f"p.p{i}")
        native = term.native if isinstance(term, CostTerm) and stage_risk == 0.0 else None
        try:
            value = native(code, bound) if native else None
        except (NotBaked, OutOfRange):
            value = None
        if value is None:
            staged.append(i)
        else:
            baked.append(TermSource(i, code.lines, value))
    return tuple(baked), staged
