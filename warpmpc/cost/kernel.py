# SPDX-License-Identifier: Apache-2.0
"""One kernel for all cost terms of a stack: written out for these terms and compiled by Warp."""

from __future__ import annotations

import hashlib
import linecache
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import warp as wp

from ..kernels.cost.view import StepView
from ..kernels.planner.costs import CostWeights, stage_weight

if TYPE_CHECKING:
    from .term import CostTerm

GENERATED = "<terms "
"""How the names of files begin that are written here."""

_SOURCE = '''
@wp.struct
class TermParams:
    """Parameters of all terms."""

{fields}


@wp.func
def evaluate_step(s: StepView, p: TermParams, weights: CostWeights, cost: wp.array3d[float]):
    """Weighted cost of every term at one step of one world."""
{calls}


@wp.func
def advance_step(s: StepView, p: TermParams):
    """Carry the terms' numbers on to one step of one world, in the order of the steps from 0 on."""
{advances}


@wp.kernel(module="unique", enable_backward=False)
def advance_kernel(
    # inputs
    view: StepView,
    p: TermParams,
    rollouts: int,  # per environment
    steps: int,
    first: int,  # world of thread 0
):
    """One thread: the numbers that terms carry along one world, from its start to its end."""
    s = view
    s.w = first + wp.tid()
    s.e = s.w // rollouts
    for t in range(steps + 1):
        s.t = t
        advance_step(s, p)


@wp.kernel(module="unique", enable_backward=False)
def evaluate_kernel(
    # inputs
    view: StepView,
    p: TermParams,
    weights: CostWeights,
    rollouts: int,  # per environment
    first: int,  # world of thread 0
    # outputs
    cost: wp.array3d[float],  # [term, T, W]
):
    """One thread: all terms at one step of one world."""
    t, thread = wp.tid()
    s = view
    s.t = t + 1
    s.w = first + thread
    s.e = s.w // rollouts
    evaluate_step(s, p, weights, cost)
'''


@dataclass(frozen=True)
class EvaluationCode:
    """Source that was written for a list of terms."""

    params: Any
    """``wp.struct`` of all their parameters, fields ``p0``, ``p1``, ..."""
    step: wp.Function
    """``(s: StepView, p: params, weights: CostWeights, cost [term, T, W])``, for kernels that do more than evaluate."""
    kernel: wp.Kernel
    """One thread per step and world."""
    advance: wp.Function
    """``(s: StepView, p: params)`` at the steps 0, 1, ... of a world, before any of them is evaluated."""
    advance_kernel: wp.Kernel
    """One thread per world."""
    advances: bool
    """True if any term carries numbers along."""


def evaluation_code(terms: Sequence[tuple[int, CostTerm]]) -> EvaluationCode:
    """Write and load the kernel that evaluates terms.

    Args:
        terms: Row in the cost array of each term, and the term.
    """
    names: dict[str, Any] = {"wp": wp, "StepView": StepView, "CostWeights": CostWeights, "stage_weight": stage_weight}
    fields, calls, advances = ["    none: int"], [], []
    # Warp knows what it has cached by this source and by the functions in it, each once: one function has one name
    called: dict[wp.Function, str] = {}
    for i, term in terms:
        names[f"Params{i}"] = term.params
        function = called.setdefault(term.function, f"term{i}")
        if term.advance is not None:
            advances.append(f"    {called.setdefault(term.advance, f'advance{i}')}(s, p.p{i})")
        fields.append(f"    p{i}: Params{i}")
        # a term without weight, or at a step at which it does not count, is off, whatever it says
        calls.append(f"    cost[{i}, s.t - 1, s.w] = 0.0")
        calls.append(f"    factor{i} = stage_weight(weights, s.e, s.t - 1, {i})")
        calls.append(f"    if factor{i} != 0.0:")
        calls.append(f"        cost[{i}, s.t - 1, s.w] = factor{i} * {function}(s, p.p{i})")
    names |= {name: function for function, name in called.items()}
    written = (fields, calls or ["    pass"], advances or ["    pass"])
    source = _SOURCE.format(**dict(zip(("fields", "calls", "advances"), map("\n".join, written), strict=True)))
    about = repr((source, [(term.function.key, term.advance and term.advance.key) for _, term in terms]))
    load_source(source, names, GENERATED, about)
    made = ("TermParams", "evaluate_step", "evaluate_kernel", "advance_step", "advance_kernel")
    return EvaluationCode(*(names[name] for name in made), advances=bool(advances))


def load_source(source: str, names: dict[str, Any], kind: str, about: str) -> None:
    """Execute generated source; Warp reads the source of what it compiles from the file it came from.

    Args:
        source: The source.
        names: Its globals, which then have what it defines.
        kind: How the name of that file begins.
        about: What the rest of the name stands for.
    """
    file = f"{kind}{hashlib.sha256(about.encode()).hexdigest()[:12]}>"
    linecache.cache[file] = (len(source), None, source.splitlines(keepends=True), file)
    exec(compile(source, file, "exec", dont_inherit=True), names)
