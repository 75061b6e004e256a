# SPDX-License-Identifier: Apache-2.0
"""Places of cost terms: the launch, whose source they become part of, or the record."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

from ..bake.lines import Lines, OutOfRange
from ..cost.code.state import Refused, TermCode
from ..cost.code.terms import TermSource
from ..cost.term import ArrayCost, CostTerm
from ..cost.trace.tracer import trace

if TYPE_CHECKING:
    from ..bake.lines import Operand
    from ..cost.code.state import StateCode
    from ..cost.stack import CostStack

logger = logging.getLogger("warpmpc")

_ON_RECORD = "cost term '%s' is evaluated on the record, not in the launch: %s"


def launch_terms(
    costs: CostStack, state: StateCode, *, stage_risk: float = 0.0
) -> tuple[tuple[TermSource, ...], list[int]]:
    """Source of all terms that can be written, and the numbers of those that cannot.

    Args:
        costs: The terms.
        state: What they may ask about a state, in which they leave what they share.
        stage_risk: R of ρ(l; R), which needs all terms of a step together: none is written where it is not zero.
    """
    in_launch, on_record = [], []
    for i, (term, bound) in enumerate(costs.terms):
        code = TermCode(state, Lines(f"t{i}_"), f"p.p{i}")
        value = term_source(code, term, bound, costs.labels[i]) if stage_risk == 0.0 else None
        if value is None:
            on_record.append(i)
        else:
            in_launch.append(TermSource(i, code.lines, value))
    return tuple(in_launch), on_record


def term_source(code: TermCode, term: CostTerm | ArrayCost, bound: Any, label: str) -> Operand | None:
    """Write a term as source: by hand where it has such a form, else traced; None where neither can be.

    Args:
        code: Where the source is written.
        term: The term.
        bound: Its filled parameter struct.
        label: What the log calls it.
    """
    if not isinstance(term, CostTerm):
        logger.info(_ON_RECORD, label, "it is a function of whole arrays")
        return None
    try:
        value = term.source(code, bound) if term.source else None
        return trace(code, term.function, bound) if value is None else value
    except (OutOfRange, Refused) as error:
        logger.info(_ON_RECORD, label, error)
        return None
