# SPDX-License-Identifier: Apache-2.0
"""Phases whose goal goes through several poses: one phase each."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from .schema_goal import Phase


def one_by_one(phases: Sequence[Phase]) -> tuple[Phase, ...]:
    """Phases with one goal each: ``NAME_1``, ``NAME_2``, ... in place of one with several.

    The last goal of the last phase is the run's: it ends with success, not with a condition.
    """
    out: list[Phase] = []
    for phase in phases:
        goals = phase.through or (phase.goal,) * (phase.count or 1)
        if len(goals) == 1 and not phase.through and phase.count is None:
            out.append(phase)
            continue
        for i, goal in enumerate(goals):
            change = {"name": f"{phase.name}_{i + 1}", "goal": goal, "through": (), "count": None}
            out.append(phase.model_copy(update=change))
        if phase is phases[-1]:
            out[-1] = out[-1].model_copy(update={"until": (), "hold": 0.0, "after": None})
    return tuple(out)


def is_of(phase: str, name: str) -> bool:
    """Return whether a phase has this name, or is one of the several goals of a phase that has it: ``NAME_1``, ..."""
    return re.fullmatch(rf"{re.escape(name)}(_\d+)?", phase) is not None


def runs_of(phases: Iterable[str]) -> list[tuple[str, str]]:
    """First and last of the names that follow one another as ``NAME_1``, ``NAME_2``, ..., in their order."""
    out: list[tuple[str, str]] = []
    for phase in phases:
        base, _, number = phase.rpartition("_")
        if out and number.isdecimal() and out[-1][1] == f"{base}_{int(number) - 1}":
            out[-1] = (out[-1][0], phase)
        else:
            out.append((phase, phase))
    return out
