# SPDX-License-Identifier: Apache-2.0
"""Symbols that stand for the values of a Warp function while it is traced."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from ...physics.runtime.bake import Lines, known
from ..code.state import Refused

MOST = 60000
"""Statements of a term at most."""

C_TYPE = {"T": "T", "S": "float", "I": "I", "i": "int", "M": "auto", "m": "bool"}
"""Type in C of each kind of number (:class:`Num`)."""


@dataclass(frozen=True)
class Num:
    """A number of the source.

    The kinds ``T`` (float), ``I`` (int) and ``M`` (mask) differ between lanes, ``S``, ``i`` and ``m`` do not.
    """

    text: str
    kind: str = "T"
    known: float | None = None
    """Value of a parameter, for branches; the source reads the number itself from the struct."""


@dataclass(frozen=True)
class Vec:
    """A vector."""

    x: tuple


@dataclass(frozen=True)
class Mat:
    """A matrix by its rows."""

    rows: tuple


@dataclass(frozen=True)
class Rot:
    """A rotation by the three columns of its matrix; a quaternion where its components are asked for."""

    columns: tuple
    quaternion: tuple | None = None
    """Components (x, y, z, w), where the function gave them."""


@dataclass(frozen=True)
class PoseSymbol:
    """A transform, or the pose of a body whose two parts are written when they are asked for."""

    rot: Rot | None
    pos: Vec | None
    body: int | None = None


@dataclass(frozen=True)
class StructSymbol:
    """A struct that a function makes."""

    fields: tuple


@dataclass(frozen=True)
class Params:
    """A struct of parameters."""

    value: Any
    text: str


@dataclass(frozen=True, eq=False)
class Array:
    """An array of parameters."""

    value: wp.array
    text: str


@dataclass(frozen=True)
class Step:
    """The view of a step, ``back`` steps before the present one."""

    back: int = 0


@dataclass(frozen=True)
class States:
    """An array of the view, by its name."""

    name: str


@dataclass(frozen=True)
class Time:
    """Slice of the present step, or of one before it; other arithmetic makes an int of it."""

    back: int = 0


class Shared(Lines):
    """Statements in which no expression is written twice."""

    def __init__(self, prefix: str):
        super().__init__(prefix)
        self.memo: dict[str, str] = {}
        """Expression → its name, within the present scope of C."""

    def fresh(self) -> str:
        """Return a new name.

        Raises:
            Refused: If the term has become too long.
        """
        self._count += 1
        if self._count > MOST:
            raise Refused(f"more than {MOST} statements")
        return f"{self.prefix}{self._count}"

    def let(self, expression: str, kind: str = "T") -> str:
        """Give an expression a name, the same one again where it was written before."""
        if expression not in self.memo:
            self.memo[expression] = name = self.fresh()
            self.names.add(name)
            self.add(f"const {C_TYPE[kind]} {name} = {expression};")
        return self.memo[expression]


def plain(x: Any) -> bool:
    """Tell if a value is a number of Python."""
    return isinstance(x, bool | int | float | np.number)


def value(x: Any) -> Any:
    """Return what is known of a number, else None."""
    return x if plain(x) else x.known if isinstance(x, Num) else None


def flat(x: Any) -> list:
    """Return the numbers of a value, row by row."""
    if isinstance(x, Vec):
        return list(x.x)
    return [y for row in x.rows for y in row] if isinstance(x, Mat) else [x]


def shaped(numbers: list, like: Any) -> Any:
    """Return numbers in the shape of a value; the inverse of :func:`flat`."""
    if isinstance(like, Vec):
        return Vec(tuple(numbers))
    if isinstance(like, Mat):
        width = len(like.rows[0])
        return Mat(tuple(tuple(numbers[k : k + width]) for k in range(0, len(numbers), width)))
    return numbers[0]


def zero_of(kind: Any) -> Any:
    """Return the value that a field of a new struct has."""
    generic = getattr(kind, "_wp_generic_type_str_", "")
    if generic == "vec_t":
        return Vec((0.0,) * kind._length_)
    if generic == "mat_t":
        rows, columns = kind._shape_
        return Mat(((0.0,) * columns,) * rows)
    if generic:
        raise Refused(f"a struct with a field of type {kind.__name__}")
    return 0 if kind in (int, wp.int32) else 0.0


def constant(x: Any, text: str, dtype: Any = None, at: int | None = None) -> Any:
    """Return a parameter as a symbol: ints and poses are written out, other numbers read from the struct.

    Args:
        x: The value.
        text: Its struct's field in the source, or the array that it is an entry of.
        dtype: Type of the entry.
        at: Number of the entry.

    Raises:
        Refused: If it is of a type that no term's parameters have.
    """
    kind = getattr(dtype or type(x), "_wp_generic_type_str_", "")
    if isinstance(x, wp.array):
        return Array(x, text)
    if kind in ("transform_t", "quat_t"):
        numbers = np.array(x, dtype=float)
        quaternion = numbers[-4:]
        columns = Rotation.from_quat(quaternion).as_matrix().T if quaternion.any() else np.zeros((3, 3))
        turn = Rot(tuple(tuple(known(column)) for column in columns), tuple(quaternion.tolist()))
        return turn if kind == "quat_t" else PoseSymbol(turn, Vec(tuple(numbers[:3].tolist())))
    if kind == "vec_t":
        numbers = np.asarray(x)
        if numbers.dtype.kind == "i":
            return Vec(tuple(int(v) for v in numbers))
        first = f"{text}[" if at is None else f"((const float*){text}.data)["
        return Vec(tuple(Num(f"{first}{i + len(numbers) * (at or 0)}]", "S", float(v)) for i, v in enumerate(numbers)))
    if kind == "mat_t":
        first = f"{text}.data" if at is None else f"{text}.data[{at}].data"
        rows = enumerate(np.array(x, dtype=float))
        return Mat(tuple(tuple(Num(f"{first}[{i}][{j}]", "S", float(v)) for j, v in enumerate(row)) for i, row in rows))
    if isinstance(x, bool | int | np.integer):
        return int(x)
    if isinstance(x, float | np.floating):
        if math.isinf(x):
            return float(x)
        return Num(text if at is None else f"{text}.data[{at}]", "S", float(x))
    if hasattr(x, "_cls"):
        return Params(x, text)
    raise Refused(f"a parameter of type {type(x).__name__}")
