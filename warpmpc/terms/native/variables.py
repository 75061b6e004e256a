# SPDX-License-Identifier: Apache-2.0
"""Parts that baked terms share: variables that later statements change, headings."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...bake.lines import Vector, text

if TYPE_CHECKING:
    from ...cost.code.state import TermCode


def variable(code: TermCode, name: str, value: str) -> str:
    """Define a variable of a term; returns its name, which no other term has."""
    name = f"{name}_{code.params.replace('.', '_')}"
    code.lines.add(f"T {name} = {value};")
    return name


def heading(code: TermCode, axis: Vector) -> tuple[str, str]:
    """Cosine and sine of the heading of an axis; of an upright one, which has none, those of zero."""
    x, y = text(axis[0]), text(axis[1])
    level = code.lines.let(f"VSQRT({x} * {x} + {y} * {y})")
    size = code.lines.let(f"VSELECT({level} > 0.0f, {level}, 1.0f)")
    return code.lines.let(f"VSELECT({level} > 0.0f, {x}, 1.0f) / {size}"), code.lines.let(f"{y} / {size}")
