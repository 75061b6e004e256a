# SPDX-License-Identifier: Apache-2.0
"""Baked source of path lengths around obstacles, beside ``kernels.terms.paths``: four gathers for a point."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...bake.lines import Operand, text
from .variables import variable

if TYPE_CHECKING:
    from ...cost.code.state import TermCode

PLACE = """const T x = VMIN(VMAX((px - origin_x) / cell, 0.0f), columns - 1.0f);
const T y = VMIN(VMAX((py - origin_y) / cell, 0.0f), rows - 1.0f);
const I i = VINT(VMIN(x, columns - 1.5f)), j = VINT(VMIN(y, rows - 1.5f));
const T u = x - VFLOAT(i), v = y - VFLOAT(j);
const I at = j * columns + i;"""
"""The cell of a point ``px``, ``py`` [m]: index ``at`` and place ``u``, ``v`` in it; clamped to the grid's border.

What is not a number is clamped, too: a lane that diverged reads inside the grid.
"""
BETWEEN = "(1.0f - v) * ((1.0f - u) * {0} + u * {1}) + v * ((1.0f - u) * {2} + u * {3})"
"""Interpolation between the four corners of a cell."""


def field(code: TermCode, index: int) -> str:
    """Statements that define ``look``, path length by x and y, and ``away``, the straight one [m].

    Args:
        code: Where they are written; the term's parameters have a field ``paths``.
        index: Which distance field.
    """
    paths = f"{code.params}.paths"
    corners = (f"VGATHER(field, at + {offset})" for offset in ("0", "1", "columns", "(columns + 1)"))
    return f"""const int rows = {paths}.length.shape[1], columns = {paths}.length.shape[2];
const int own = e * {paths}.count + {index};
const float* field = (const float*){paths}.length.data + (size_t)own * rows * columns;
const float* target = (const float*){paths}.center.data + 2 * own;
const float cell = {paths}.cell, origin_x = {paths}.origin[0], origin_y = {paths}.origin[1];
const auto look = [&](T px, T py) -> T {{
{PLACE}
return {BETWEEN.format(*corners)};
}};
const auto away = [&](T px, T py) -> T {{
const T dx = px - target[0], dy = py - target[1];
return VSQRT(dx * dx + dy * dy);
}};"""


def detour(code: TermCode, index: int, at: list[Operand]) -> str:
    """By how much the way from a point is longer than the straight one, as in ``paths.plane_distance`` [m]."""
    x, y = text(at[0]), text(at[1])
    longer = variable(code, "detour", "(T)0.0f")
    code.lines.add(f"{{ {field(code, index)}")
    code.lines.add(f"{longer} = VMAX(look({x}, {y}) - away({x}, {y}) - 0.25f * cell, 0.0f); }}")
    return longer
