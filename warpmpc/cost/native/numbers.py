# SPDX-License-Identifier: Apache-2.0
"""Baked source of residuals that are numbers of one kind."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ...bake.lines import Operand
from ...kernels.terms import numbers as kinds
from .general import length
from .norms import norm
from .residuals import less_wanted

if TYPE_CHECKING:
    from ..code.state import TermCode


def numbers(code: TermCode, p: Any) -> Operand:
    """``numbers.numbers_cost``."""
    kind = int(p.kind)
    values = [_number(code, kind, int(at)) for at in p.index.numpy()]
    return norm(code, less_wanted(code, values, p), p)


def _number(code: TermCode, kind: int, at: int) -> Operand:
    """``numbers.number``."""
    state = code.state
    if kind == int(kinds.JOINT_POSITION):
        return state.coordinate(at)
    if kind == int(kinds.JOINT_VELOCITY):
        return state.speed(at)
    if kind == int(kinds.CONTROL):
        return f"c{at}"
    if kind == int(kinds.SENSOR):
        return state.sensor(at)
    if kind == int(kinds.CONTACT):
        strength = length(code, state.force(at))
        return code.lines.let(f"VSELECT({strength} > {code.params}.least, 1.0f, 0.0f)")
    return state.force(at // 3)[at % 3]
