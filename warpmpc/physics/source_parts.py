# SPDX-License-Identifier: Apache-2.0
"""The parts of a source, put together whole, or as two: rollouts, and the steps of the model that they call.

The step of a model on a CPU, compiled by itself: what rolls it out and what evaluates that are compiled apart.

Constant tables in C.

The kernel that rolls worlds out, made for one model.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import warp as wp

from .runtime.bake import LARGEST, WIDE, header, literal
from .runtime.compiling import compile_made
from .runtime.launch import Launcher

CONTRACT = " -ffp-contract=fast"
"""Compiler flag for products and sums in one instruction: a fifth less time in `mobile_pick`."""
WARP = 32
"""Lanes of a warp."""


@wp.struct
class RolloutWork:
    """Arrays that rollouts start from and follow, and those that they fill."""

    knots: wp.array4d[float]  # [E, S, P, nu]
    tap: wp.array3d[int]  # [E, T, TAPS] knots that a step's control depends on
    share: wp.array3d[float]  # [E, T, TAPS] how much of each
    lower: wp.array[float]  # [nu]
    upper: wp.array[float]  # [nu]
    domains: int  # worlds of a sample
    initial: wp.array2d[wp.float64]  # [W, 1+nq+nv+na] MuJoCo's state with its time, where worlds have their own start
    reached: wp.array2d[wp.float64]  # [W, 1+nq+nv+na] where these worlds end; empty if not asked for
    joint_q: wp.array2d[float]  # [E, nq] observed
    joint_qd: wp.array2d[float]  # [E, nv] observed
    act: wp.array2d[float]  # [E, na] observed
    mocap: wp.array2d[wp.transform]  # [E, nm] observed
    pose: wp.array2d[wp.transform]  # [E, poses] of the task, those of obstacles that move with it last
    substeps: wp.array[int]  # [T] physics steps in each control step
    steps: wp.array[wp.uint64]  # [CALLS] on a CPU, addresses of what moves worlds on (:class:`~.steps.Steps`)
    given: wp.array[float]  # numbers of the model that are no part of the source
    par: wp.array2d[float]  # [P, W] what differs between worlds
    chosen: wp.array[int]  # [N] worlds to record, those of one environment side by side; empty to evaluate all
    records: int  # whether rollouts are recorded; N is W below where all are
    control: wp.array3d[float]  # [T, N, nu]
    record_q: wp.array3d[float]  # [T+1, N, nq]
    record_qd: wp.array3d[float]  # [T+1, N, nv]
    record_act: wp.array3d[float]  # [T+1, N, na]
    record_body_q: wp.array3d[wp.transform]  # [T+1, N, nb]
    record_body_qd: wp.array3d[wp.spatial_vector]  # [T+1, N, nb]
    force: wp.array3d[wp.vec3]  # [T, N, pair] [N] on the pair's first side
    sensor: wp.array3d[float]  # [T, N, ns]
    diverged: wp.array[int]  # [N] nonzero where the physics failed
    overflow: wp.array[int]  # [N] nonzero where contacts were lost


def options(lanes: int) -> dict[str, object]:
    """Options of the module of a kernel whose threads take a number of worlds each on a CPU."""
    flags = (wp.config.cpu_compiler_flags or "") + (WIDE if lanes == 16 else "") + CONTRACT
    return {"cpu_compiler_flags": flags, "fast_math": True}


def make_kernel(source: str, lanes: int, threads: int) -> wp.Kernel:
    """Compile the source of rollouts into a kernel.

    Args:
        source: Body of the native function (:class:`~.source.RolloutSource`).
        lanes: Worlds that a thread takes on a CPU; on a GPU a thread takes one.
        threads: Threads that share a world on a GPU, else 1.
    """
    sharing = wp.constant(threads)

    @wp.func_native(source)
    def rollout_plain(k: RolloutWork, group: int): ...

    @wp.kernel(module="unique", enable_backward=False, module_options=options(lanes))
    def rollout_kernel(
        # inputs
        first: int,  # group of thread 0
        # inputs and outputs
        k: RolloutWork,
    ):
        """One thread: all steps of as many worlds as a number has lanes; on a GPU of one, or its part of one."""
        rollout_plain(k, first + wp.tid() // sharing)

    return rollout_kernel


def floats(name: str, values: object) -> str:
    """Definition of a table of numbers, of any shape, row by row.

    Raises:
        OutOfRange: If single precision does not hold one of them.
    """
    row = np.ravel(np.asarray(values, dtype=np.float64))
    if not (fits := np.abs(row) <= LARGEST).all():
        literal(row[~fits][0])
    numbers = ", ".join(f"{x!r}f" for x in row.astype(np.float32).tolist())  # meshes have a million
    return f"static const float {name}[{max(1, row.size)}] = {{{numbers or '0.0f'}}};"


def ints(name: str, values: object, kind: str = "int") -> str:
    """The same of integers."""
    row = np.ravel(np.asarray(values, dtype=np.int64))
    return f"static const {kind} {name}[{max(1, row.size)}] = {{{', '.join(map(str, row)) or '0'}}};"


LONG = 20_000
"""Characters of a table from which it is packed."""
_KINDS = {"float": np.float32, "int": np.int32, "short": np.int16}
_BYTES = [f"\\{byte:03o}" for byte in range(256)]


def packed(source: str) -> str:
    """Source for a CPU whose long tables are bytes of a text, which compilers read ten times as fast as numbers."""
    return "\n".join(_packed(line) if len(line) > LONG else line for line in source.split("\n"))


def _packed(line: str) -> str:
    head, _, numbers = line.removesuffix("};").partition(" = {")
    *_, kind, name = head.split(" ")
    if not head.startswith("static const ") or kind not in _KINDS or ";" in numbers:
        return line
    name = name.partition("[")[0]
    row = np.fromstring(numbers.replace("f", ""), dtype=np.float64, sep=",").astype(_KINDS[kind])
    text = "".join(map(_BYTES.__getitem__, row.tobytes()))
    return (
        f'static const char {name}_bytes[] __attribute__((aligned(64))) = "{text}";\n'
        f"static const {kind}* const {name} = (const {kind}*){name}_bytes;"
    )


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


class Steps:
    """Functions of a model's step; a caller that uses their addresses keeps this object meanwhile.

    Args:
        parts: Parts of the source.
        what: What is stepped, for the message about compiling.

    Raises:
        KernelError: If it does not compile.
        OSError: If Warp's folder of compiled kernels cannot be written.
    """

    def __init__(self, parts: Parts, what: str):
        text = packed(parts.step_functions())
        self._kernel = compile_made(partial(_make, text), options(parts.lanes), "cpu", 1, what, source=text)
        self.address = wp.zeros(len(CALLS), dtype=wp.uint64, device="cpu")
        """Addresses of :data:`~.parts.CALLS`."""
        Launcher("cpu")(self._kernel, 1, [], [self.address])


def _make(text: str, *, options: Mapping[str, object]) -> wp.Kernel:
    """The kernel that tells the addresses; Warp makes one of a text."""

    @wp.func_native(text)
    def write_addresses(address: wp.array[wp.uint64]): ...

    @wp.kernel(module="unique", enable_backward=False, module_options=dict(options))
    def steps_kernel(
        # outputs
        address: wp.array[wp.uint64],  # [CALLS]
    ):
        """One thread: the addresses of the functions of a step."""
        write_addresses(address)

    return steps_kernel
