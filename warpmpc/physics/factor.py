# SPDX-License-Identifier: Apache-2.0
"""Source of products and solves with matrices that have the mass matrix's pattern, along the tree without fill-in.

A symmetric matrix is kept by rows (:func:`.tree.packed`); where two degrees of freedom are on different branches
its entry is zero and never touched (Featherstone 2008, section 6.5).
"""

from __future__ import annotations

from collections.abc import Sequence

from .base import packed
from .model import PhysicsModel


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


def write_solve(
    name: str, above: Sequence[Sequence[int]], *, damped: bool = False, tree: Sequence[Sequence[int]] | None = None
) -> str:
    """Source of x = sign H⁻¹ g by Lᵀ D L, from the last degree of freedom to the first and back.

    Args:
        name: Name of the function.
        above: Columns left of the diagonal of every row, falling.
        damped: Whether a vector is added to the diagonal.
        tree: Columns that come first on the way back, then zeros may follow and change no bit: a compiler fuses the
            first product of a sum with what it is added to. All of them if None.
    """
    tree = above if tree is None else tree
    extra, more = (", const T* damp", " + damp[{}]") if damped else ("", "")
    out = [f"FN void {name}(const T* h, const T* g, T* x, float sign{extra}) {{"]
    for k, row in enumerate(above):
        out.append(f"T x{k} = sign * g[{k}], h{k}_{k} = h[{packed(k, k)}]{more.format(k)};")
        out += [f"T h{k}_{j} = h[{packed(k, j)}];" for j in row]
    for k in reversed(range(len(above))):
        out.append(f"{{ const T inv = 1.0f / h{k}_{k};")
        for i in above[k]:
            out.append(f"{{ const T a = h{k}_{i} * inv;")
            out += [f"h{i}_{j} -= a * h{k}_{j};" for j in above[k] if j <= i]
            out.append(f"x{i} -= a * x{k}; h{k}_{i} = a; }}")
        out.append(f"x{k} *= inv; }}")
    for k, row in enumerate(above):
        out += [f"x{k} -= h{k}_{i} * x{i};" for i in sorted(row, key=lambda i: (i not in tree[k], i))]
        out.append(f"x[{k}] = x{k};")
    return "\n".join((*out, "}"))
