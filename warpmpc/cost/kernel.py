# SPDX-License-Identifier: Apache-2.0
"""One kernel for all cost terms of a stack: written out for these terms and compiled by Warp."""

from __future__ import annotations

import hashlib
import linecache
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import warp as wp

from ..kernels.terms.view import StepView

_SOURCE = '''
@wp.struct
class JudgeParams:
    """Parameters of all terms."""

{fields}


@wp.func
def judge_step(s: StepView, p: JudgeParams, weight: wp.array2d[float], cost: wp.array3d[float]):
    """Weighted cost of every term at one step of one world."""
{calls}


@wp.kernel(module="unique", enable_backward=False)
def judge_kernel(
    # inputs
    view: StepView,
    p: JudgeParams,
    weight: wp.array2d[float],  # [E, term]
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
    judge_step(s, p, weight, cost)
'''


@dataclass(frozen=True)
class JudgeCode:
    """What was written for a list of terms."""

    params: Any
    """``wp.struct`` of all their parameters, fields ``p0``, ``p1``, ..."""
    step: wp.Function
    """``(s: StepView, p: params, weight [E, term], cost [term, T, W])``, for kernels that judge on the way."""
    kernel: wp.Kernel
    """One thread per step and world."""


def judge_code(terms: Sequence[tuple[int, wp.Function, Any]]) -> JudgeCode:
    """Write and load the kernel that evaluates terms.

    Args:
        terms: Row in the cost array, Warp function and parameter struct of each term.
    """
    names: dict[str, Any] = {"wp": wp, "StepView": StepView}
    fields, calls = ["    none: int"], []
    for i, function, params in terms:
        names[f"Params{i}"], names[f"term{i}"] = params, function
        fields.append(f"    p{i}: Params{i}")
        # a term without weight is off, whatever it says
        calls.append(f"    cost[{i}, s.t - 1, s.w] = 0.0")
        calls.append(f"    if weight[s.e, {i}] != 0.0:")
        calls.append(f"        cost[{i}, s.t - 1, s.w] = weight[s.e, {i}] * term{i}(s, p.p{i})")
    source = _SOURCE.format(fields="\n".join(fields), calls="\n".join(calls or ["    pass"]))
    # Warp reads the source of what it compiles from the file it came from
    about = repr((source, [function.key for _, function, _ in terms]))
    file = f"<judge {hashlib.sha256(about.encode()).hexdigest()[:12]}>"
    linecache.cache[file] = (len(source), None, source.splitlines(keepends=True), file)
    exec(compile(source, file, "exec", dont_inherit=True), names)
    return JudgeCode(names["JudgeParams"], names["judge_step"], names["judge_kernel"])
