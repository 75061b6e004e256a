# SPDX-License-Identifier: Apache-2.0
"""Baked source of the terms of a hand that picks an object up, beside ``kernels.terms.grasping``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ...bake.lines import Operand, text
from ...bake.number import decay
from .general import length

if TYPE_CHECKING:
    from ..code.state import TermCode


def approach(code: TermCode, p: Any) -> Operand:
    """``grasping.approach``."""
    lines, params = code.lines, code.params
    hand = code.state.frame(p.hand)
    d = lines.difference(code.state.frame(p.object).position, hand.position)
    x, y = (text(lines.dot(axis, d)) for axis in hand.columns[:2])
    r = lines.let(f"({x} * {x} + {y} * {y}) / ({params}.width * {params}.width)")
    r = lines.let(f"{r} * {r}")
    fourth, over = lines.let(f"{r} * {r}"), f"over_{r}"
    lines.add(decay(fourth, over))
    low = lines.let(f"VMAX({params}.rise * (1.0f - {over}) + {text(d[2])}, 0.0f)")
    return lines.let(f"VSQRT({text(lines.dot(d, d))} + 1.0e-4f) - 0.01f + 2.0f * {low}")


def finger_alignment(code: TermCode, p: Any) -> Operand:
    """``grasping.finger_alignment``."""
    lines = code.lines
    across = code.state.frame(p.hand).columns[1]
    along = [text(lines.dot(axis, across)) for axis in code.state.frame(p.object).columns]
    squares = [lines.let(f"{a} * {a}") for a in along]
    return lines.let(f"2.0f - 2.0f * {text(lines.dot(squares, squares))}")


def gripper(code: TermCode, p: Any) -> Operand:
    """``grasping.gripper``."""
    lines, fingers = code.lines, p.finger.numpy().tolist()
    shares = [
        lines.let(f"(c{u} - {code.params}.middle.data[{n}]) / s.control_scale.data[{u}]") for n, u in enumerate(fingers)
    ]
    mean = lines.let(f"({' + '.join(shares)}) / {len(shares)}.0f")
    d = lines.difference(code.state.frame(p.object).position, code.state.frame(p.hand).position)
    near = f"{length(code, d)} < {code.params}.near"
    return lines.let(f"VSELECT({near}, 0.5f * (1.0f + {mean}), 1.5f - 0.5f * {mean})")
