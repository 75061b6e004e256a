# SPDX-License-Identifier: Apache-2.0
"""Source of cost terms that a rollout evaluates on its way: written by any engine, around a state of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ...bake.lines import Lines, Operand, text

POINTERS = """const float* q_start = (const float*)k.joint_q.data + e * k.joint_q.shape[1];
const float* qd_start = (const float*)k.joint_qd.data + e * k.joint_qd.shape[1];
const float* mocap_start = (const float*)k.mocap.data + 7 * e * k.mocap.shape[1];
const float* weight = (const float*)sums.weights.term.data + e * sums.weights.term.shape[1];
const float* last_control = (const float*)s.last_control.data + e * controls;"""
"""Pointers that the source of terms reads of an environment ``e``."""
TIMES = """const float dt = sums.dt.data[at];
const float discount = live ? sums.weights.discount.data[at] : 0.0f;
const float* terminal = (const float*)sums.weights.terminal.data + at * sums.weights.terminal.shape[1];
const float gap = at == 0 ? dt : 0.5f * (dt + sums.dt.data[at - 1]); // between the middles of two steps
const float left = s.step_end.data[steps] - s.step_end.data[at]; // of the horizon when the step begins"""
"""Times and factors of the step ``at``."""


@dataclass(frozen=True)
class TermSource:
    """The source of one term."""

    index: int
    """Its row among all terms."""
    lines: Lines
    value: Operand

    @property
    def start(self) -> str:
        """Its sum, before the first step."""
        return f"T total{self.index} = (T)0.0f;"

    @property
    def step(self) -> str:
        """Its statements of one step; without weight, or at a step at which it does not count, it is off."""
        body = "\n".join(self.lines.statements)
        total = f"total{self.index} += discount * terminal[{self.index}] * {text(self.value)};"
        counts = f"weight[{self.index}] != 0.0f && terminal[{self.index}] != 0.0f"
        return f"if (live && {counts}) {{\n{body}\n{total}\n}}"

    def end(self, world: str, lane: str = "") -> str:
        """Its cost over the horizon in a world, after the last step."""
        i = self.index
        return f"sums.total.data[{i} * worlds + {world}] = weight[{i}] * total{i}{lane};"


def sums(terms: Sequence[TermSource]) -> str:
    """Statements that write the sums of ``count`` samples from ``row`` on down, on a CPU."""
    return "\n".join(("for (int l = 0; l < count; ++l) {", *(term.end("row + l", "[l]") for term in terms), "}"))
