# SPDX-License-Identifier: Apache-2.0
"""The parts of a source, put together whole, or as two: rollouts, and the steps of the model that they call."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from ..bake.simd import header

CALLS = ("place", "move", "step", "watch", "forward")
"""Functions of a world that rollouts call."""
_OPTIONAL = {"watch": "WATCHED", "forward": "SENSED"}
"""Functions that are there where a macro is not zero."""
_MACROS = ("FN", "INLINE", "INNER", "UNROLL", "VNOT", "VBITS", "FMA", "YES", "NO", "LANE", "PUT", "COOPERATE", "EACH",
           "SYNC", "NEAR_PAIRS", "BY_DEVICE", *(f"{name.upper()}_WORLD" for name in CALLS))  # fmt: skip
_TABLE = re.compile(r"static const \w+ (\w+)\[")


@dataclass(frozen=True)
class AddedCode:
    """Statements around the steps of a rollout that evaluate it on the way, on a CPU (``native/rollout.h``)."""

    start: str
    """Before the first step."""
    before: str
    """Before each."""
    step: str
    """After each."""
    end: str
    """At the end."""
    first: int
    """First step that they look at: -1 where they ask for the observed state."""


@dataclass(frozen=True, kw_only=True)
class Parts:
    """Texts and constants of a model's rollouts."""

    lanes: int
    """Worlds in a vector on a CPU."""
    defines: Mapping[str, object]
    """Macros and their values."""
    types: str
    """Macros for either device."""
    tables: Sequence[str]
    """Constant tables."""
    warp_tables: Sequence[str]
    """Constant tables of a warp whose lanes share a world."""
    world: Sequence[str]
    """State of worlds."""
    steps: Sequence[str]
    """Functions that move it on: those of :data:`CALLS`, and what they need."""
    joints: str
    """Functions that convert it."""
    rollout: str
    """Statements of a rollout."""

    def whole(self) -> str:
        """The source of rollouts with their steps."""
        tables = (*self.tables, "#if COOPERATE", *self.warp_tables, "#endif")
        calls = (f"#define {name.upper()}_WORLD(w) Sim::{name}(w)" for name in CALLS)
        inside = (*self.world, *self.steps, self.joints)
        return self._text(self.defines, tables, inside, [*calls, self.rollout])

    def rollouts(self) -> str:
        """The source of rollouts on a CPU, whose steps are functions at the addresses in ``k.steps``."""
        calls = (
            f"#define {name.upper()}_WORLD(w) ((void (*)(Sim::World&))(size_t)k.steps.data[{n}])(w)"
            for n, name in enumerate(CALLS)
        )
        return self._needed((*self.world, self.joints), [*calls, self.rollout])

    def step_functions(self) -> str:
        """The source that writes the addresses of the steps' functions into ``address``, on a CPU.

        It has nothing of what rollouts ask for or how they are evaluated, so that they share it.
        """
        body = (
            f"address.data[{n}] = (wp::uint64)(size_t)(void (*)(Sim::World&))&Sim::{name};"
            for n, name in enumerate(CALLS)
            if name not in _OPTIONAL or self.defines[_OPTIONAL[name]]
        )
        return self._needed((*self.world, *self.steps), body)

    def _needed(self, inside: Iterable[str], body: Iterable[str]) -> str:
        """A source with those macros and tables alone whose names are in it."""
        inside, body = list(inside), list(body)
        words = set(re.findall(r"\w+", "\n".join((self.types, *inside, *body))))
        macros = {name.partition("(")[0]: name for name in self.defines}
        kept: dict[str, object] = {}
        while more := [name for word, name in macros.items() if word in words and name not in kept]:
            kept |= {name: self.defines[name] for name in more}
            words |= set(re.findall(r"\w+", " ".join(str(self.defines[name]) for name in more)))
        tables = [text for text in self.tables if (found := _TABLE.match(text)) is None or found[1] in words]
        defines = {name: value for name, value in self.defines.items() if name in kept}
        return self._text(defines, tables, inside, body)

    def _text(
        self, defines: Mapping[str, object], tables: Iterable[str], inside: Iterable[str], body: Iterable[str]
    ) -> str:
        undo = "\n".join(f"#undef {name.partition('(')[0]}" for name in (*_MACROS, *defines))
        defined = "\n".join(f"#define {name} {value}" for name, value in defines.items())
        sim = "\n".join(("struct Sim {", *inside, "};"))
        return "\n".join((header(self.lanes), undo, defined, self.types, *tables, sim, *body, undo, ""))
