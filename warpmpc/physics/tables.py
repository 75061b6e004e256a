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
