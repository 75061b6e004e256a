# SPDX-License-Identifier: Apache-2.0
"""Source of the terms of an arm (Bhardwaj et al., STORM, CoRL 2021)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ...physics.runtime.bake import Operand, text

if TYPE_CHECKING:
    from .state import TermCode
    from .tree import Axis


def manipulability(code: TermCode, p: Any) -> Operand:
    """``arm.manipulability`` (Eq. 10): √det(J Jᵀ), which does not depend on the point that J looks at."""
    state, lines, params = code.state, code.lines, code.params
    axes = chain_axes(code, p)
    turning = [axis for axis in axes if axis.turns]
    # the axes of a wrist meet in one point: from there two of its columns have no linear part
    about = turning[-2 if len(turning) > 1 else -1].origin if turning else state.frame(p.of).position
    columns = [[*(axis.direction if axis.turns else [0.0] * 3), *state.tree.lever(axis, about)] for axis in axes]
    if len(columns) < 6:
        gram = {(i, j): lines.dot(columns[i], columns[j]) for i in range(len(columns)) for j in range(i + 1)}
    else:
        rows = [[column[i] for column in columns] for i in range(6)]
        gram = {(i, j): lines.dot(rows[i], rows[j]) for i in range(6) for j in range(i + 1)}
    _, pivots = factorize(code, gram, min(len(columns), 6))
    m = lines.let(f"VSQRT(VMAX({' * '.join(pivots)}, 0.0f))")
    if p.step:
        return lines.let(f"VSELECT({m} < {params}.least, 1.0f - {m}, 0.0f)")
    return lines.let(f"VMAX(({params}.least - {m}) / {params}.least, 0.0f)")


def chain_axes(code: TermCode, p: Any) -> list[Axis]:
    """The axes that are columns of a term's Jacobian, in the order of its parameters."""
    place = code.state.frame(p.of).place
    by_coord = {int(code.state.layout.dof_coord[axis.dof]): axis for axis in place.axes}
    return [by_coord[int(i)] for i in p.chain.coord.numpy()[p.chain.column.numpy()]]


def factorize(code: TermCode, gram: dict[tuple[int, int], Operand], n: int) -> tuple[dict, list[str]]:
    """L and D of L D Lᵀ for a symmetric matrix, given by its lower half."""
    lines, pivots = code.lines, []
    low: dict[tuple[int, int], str] = {}
    work: dict[tuple[int, int], str] = {}
    for j in range(n):
        for i in range(j, n):
            taken = "".join(f" - {work[i, k]} * {low[j, k]}" for k in range(j))
            work[i, j] = lines.let(f"{text(gram[i, j])}{taken}")
        pivots.append(lines.let(f"VMAX({work[j, j]}, 1.0e-9f)"))  # what rounding makes of a singular posture
        for i in range(j + 1, n):
            low[i, j] = lines.let(f"{work[i, j]} / {pivots[j]}")
    return low, pivots
