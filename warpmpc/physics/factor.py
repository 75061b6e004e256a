# SPDX-License-Identifier: Apache-2.0
"""Source of products and solves with matrices that have the mass matrix's pattern, along the tree without fill-in.

A symmetric matrix is kept by rows (:func:`.tree.packed`); where two degrees of freedom are on different branches
its entry is zero and never touched (Featherstone 2008, section 6.5).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .base import packed
from .model import PhysicsModel
from .source_parts import ints

MOST_OPERATIONS = 45000
"""Of a solve that is written out: as many as 64 degrees of freedom take that are all coupled."""
TILE_ROWS, TILE_COLUMNS = 4, 6
"""Rows and columns of a tile of L: 24 numbers, which 32 registers have room for with those that change them."""


def write_products(model: PhysicsModel) -> str:
    """Source of ``multiply`` (M a), ``copy_tree`` (entries of the pattern) and the solves; a warp has its own."""
    solves = (
        write_solve("solve_tree", model.ancestors),
        write_solve("solve_damped", model.ancestors, damped=True),
    )
    return "\n".join(("#if !COOPERATE", _multiply(model), _copy(model), *solves, "#endif"))


def _multiply(model: PhysicsModel) -> str:
    nv, above = model.mj.nv, model.ancestors
    out = ["FN void multiply(const T* mm, const T* a, T* out) {"]
    out += [f"const T a{i} = a[{i}]; T o{i} = mm[{packed(i, i)}] * a{i};" for i in range(nv)]
    for i in range(nv):
        out += [f"{{ const T x = mm[{packed(i, j)}]; o{i} += x * a{j}; o{j} += x * a{i}; }}" for j in above[i]]
    out += [f"out[{i}] = o{i};" for i in range(nv)]
    return "\n".join((*out, "}"))


def _copy(model: PhysicsModel) -> str:
    entries = [packed(i, j) for i in range(model.mj.nv) for j in [i, *model.ancestors[i]]]
    copies = (f"b[{at}] = a[{at}];" for at in entries)
    return "\n".join(("INLINE void copy_tree(const T* a, T* b) {", *copies, "}"))


def couple(model: PhysicsModel, groups: Sequence[Sequence[int]]) -> list[list[int]]:
    """Columns left of the diagonal of every row of L, falling, when contacts couple all of some groups; with fill-in.

    Args:
        model: The model.
        groups: Degrees of freedom of each group.
    """
    rows = [set(chain) for chain in model.ancestors]
    for dofs in groups:
        for i in dofs:
            rows[i] |= {j for j in dofs if j < i}
    for row in reversed(rows):
        for i in row:
            rows[i] |= {j for j in row if j < i}
    return [sorted(row, reverse=True) for row in rows]


def operations(rows: Sequence[Sequence[int]]) -> int:
    """Products that a solve takes, roughly, with these columns left of the diagonal of every row."""
    return sum(len(row) ** 2 for row in rows) // 2


def loop_tables(rows: Sequence[Sequence[int]]) -> list[str]:
    """Tables of the solve in loops (``native/lanes.h``)."""
    columns = ints("coupled_column", [j for row in rows for j in row], "short")
    return [ints("coupled_first", np.cumsum([0, *(len(row) for row in rows)])), columns]


def write_solve(name: str, above: Sequence[Sequence[int]], *, damped: bool = False) -> str:
    """Source of x = sign H⁻¹ g by H = Lᵀ L, from the last degree of freedom to the first and back.

    Entries of L are made tile by tile, so that a tile stays in registers while all rows below subtract from it, always
    from the last row on: where an entry is zero it changes no bit, so that matrices with less fill-in give the same.

    Args:
        name: Name of the function.
        above: Columns left of the diagonal of every row, falling.
        damped: Whether a vector is added to the diagonal.
    """
    extra, more = (", const T* damp", " + damp[{}]") if damped else ("", "")
    rows, count = [{*row, k} for k, row in enumerate(above)], len(above)
    out = [f"FN void {name}(const T* h, const T* g, T* x, float sign{extra}) {{"]
    for last in range(count - 1, -1, -TILE_ROWS):
        block = range(last, max(-1, last - TILE_ROWS), -1)
        columns = sorted(set().union(*(rows[k] for k in block)), reverse=True)
        below = [m for m in range(count - 1, last, -1) if not rows[m].isdisjoint(block)]
        own = [(k, j) for k in block for j in block if j in rows[k]]
        out += [f"T h{k}_{j} = h[{packed(k, j)}]{more.format(k) if k == j else ''};" for k, j in own]
        out += [f"T x{k} = sign * g[{k}];" for k in block]
        for m in below:
            out += [less(f"h{k}_{j}", f"h{m}_{k}", f"h{m}_{j}") for k, j in own if {k, j} <= rows[m]]
            out += [less(f"x{k}", f"h{m}_{k}", f"x{m}") for k in block if k in rows[m]]
        for k in block:
            out.append(f"const T d{k} = 1.0f / VSQRT(h{k}_{k}); x{k} *= d{k};")
            left = [j for j in block if j < k and j in rows[k]]
            out += [f"h{k}_{j} *= d{k};" for j in left]
            for i in left:
                out += [less(f"h{i}_{j}", f"h{k}_{i}", f"h{k}_{j}") for j in left if j <= i]
                out.append(less(f"x{i}", f"h{k}_{i}", f"x{k}"))
        columns = [j for j in columns if j < block[-1]]
        for first in range(0, len(columns), TILE_COLUMNS):
            tile = [(k, j) for j in columns[first : first + TILE_COLUMNS] for k in block if j in rows[k]]
            out += [f"T h{k}_{j} = h[{packed(k, j)}];" for k, j in tile]
            for m in (*below, *block):
                out += [f"h{m}_{j} *= d{m};" for k, j in tile if k == m]
                out += [less(f"h{k}_{j}", f"h{m}_{k}", f"h{m}_{j}") for k, j in tile if k < m and {k, j} <= rows[m]]
    for k, row in enumerate(above):
        out += [less(f"x{k}", f"h{k}_{i}", f"x{i}") for i in sorted(row)]
        out.append(f"x[{k}] = x{k} *= d{k};")
    return "\n".join((*out, "}"))


def less(to: str, a: str, b: str) -> str:
    """Return a statement that takes a product away, with one rounding whatever stands around it."""
    return f"{to} = FMA(-{a}, {b}, {to});"
