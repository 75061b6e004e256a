# SPDX-License-Identifier: Apache-2.0
"""Source of the cost terms that are summed on the way, around the physics' steps; on a CPU."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ...bake.terms import POINTERS, TIMES, TermSource, sums

if TYPE_CHECKING:
    from .state import PhysicsState


@dataclass(frozen=True)
class Judged:
    """Terms, and what they ask about the state."""

    state: PhysicsState
    terms: tuple[TermSource, ...]

    @property
    def first(self) -> int:
        """First step that they look at: -1 where they ask what something was in the observed state."""
        return -1 if self.state.kept or self.state.held else 0

    def parts(self) -> dict[str, str]:
        """Statements before the first step, before each, after each, and at the end (``native/rollout.h``)."""
        state, controls = self.state, range(self.state.layout.nu)
        then = (*state.kept.values(), *state.held.values())
        start = (
            POINTERS,
            *state.once.statements,
            *(term.start for term in self.terms),
            *(f"T {name} = (T)0.0f;" for name in then),
        )
        step = (
            TIMES,
            *(f"const T c{u} = w.c[{u}];" for u in controls),
            *state.lines.statements,
            *(f"if (!live) {name} = {value};" for value, name in state.held.items()),
            *(term.step for term in self.terms),
            *(f"{name} = {value};" for value, name in state.kept.items()),
        )
        before = (f"const T d{u} = h > 0 ? w.c[{u}] : (T)last_control[{u}];" for u in controls)
        lines = {"START": start, "BEFORE": before, "STEP": step, "END": (sums(self.terms),)}
        return {f"TERMS_{name}": "\n".join(statements) for name, statements in lines.items()}
