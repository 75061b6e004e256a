# SPDX-License-Identifier: Apache-2.0
"""Constant tables in C."""

from __future__ import annotations

import numpy as np

from ..bake.lines import LARGEST, literal


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
