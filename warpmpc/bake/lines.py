# SPDX-License-Identifier: Apache-2.0
"""Straight-line source: operands are names of C variables or Python floats, and what is known is folded away."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

Operand = str | float
"""A C expression that needs no parentheses in a product, or a number that is known."""
Vector = list[Operand]
"""Three operands."""
Matrix = list[Vector]
"""Three columns."""

EXACT = 2e-7
"""Entries of rotations this close to 0, 1 or -1 are that number: layouts hold poses in single precision."""

LARGEST = float(np.finfo(np.float32).max)


class OutOfRange(ValueError):
    """A number that single precision does not hold."""


def literal(x: float) -> str:
    """A number in C, in single precision.

    Raises:
        OutOfRange: If it does not hold this one.
    """
    if not abs(x) <= LARGEST:
        raise OutOfRange(f"{x:g} does not fit into single precision")
    return repr(float(np.float32(x))) + "f"


def text(x: Operand) -> str:
    """An operand in C, of the SIMD type."""
    return x if isinstance(x, str) else f"((T){literal(x)})"


def known(values: Sequence[float] | np.ndarray) -> list[float]:
    """Entries of a rotation or an axis, those next to 0, 1 or -1 rounded."""
    rounded = np.round(np.asarray(values, dtype=float))
    near = np.abs(values - rounded) < EXACT
    return [float(x) for x in np.where(near, rounded, values)]


class Lines:
    """Statements in C, one after the other.

    Args:
        prefix: What the names of its variables begin with; no other list of the same function may have it.
    """

    def __init__(self, prefix: str = "e"):
        self.statements: list[str] = []
        self.names: set[str] = set()
        """Variables that are defined."""
        self.prefix, self._count = prefix, 0

    def add(self, statement: str) -> None:
        """Append a statement."""
        self.statements.append(statement)

    def let(self, expression: str) -> str:
        """Give an expression a name."""
        self._count += 1
        name = f"{self.prefix}{self._count}"
        self.names.add(name)
        self.add(f"const T {name} = {expression};")
        return name

    def sum(self, *terms: Operand | tuple[Operand, Operand]) -> Operand:
        """Σ of operands and of products of two operands."""
        constant, parts = 0.0, []
        for term in terms:
            a, b = term if isinstance(term, tuple) else (term, 1.0)
            if isinstance(a, str) and isinstance(b, float):
                a, b = b, a
            if isinstance(a, float) and isinstance(b, float):
                constant += a * b
            elif isinstance(a, str):
                parts.append(f" + {a} * {b}")
            elif a != 0.0:
                factor = "" if abs(a) == 1.0 else f"{literal(abs(a))} * "
                parts.append(f" {'+' if a > 0.0 else '-'} {factor}{b}")
        if not parts:
            return constant
        if len(parts) == 1 and not constant and parts[0].startswith(" + ") and "*" not in parts[0]:
            return parts[0][3:]
        parts.sort(key=lambda part: part.startswith(" - "))  # an expression that begins with a minus takes longer
        if constant:
            parts.append(f" {'+' if constant > 0.0 else '-'} {literal(abs(constant))}")
        joined = "".join(parts)
        return self.let(joined[3:] if joined.startswith(" + ") else joined.strip())

    def difference(self, a: Vector, b: Vector) -> Vector:
        """A - b."""
        return [0.0 if x == y else self.sum(x, (-1.0, y)) for x, y in zip(a, b, strict=True)]

    def dot(self, a: Vector, b: Vector) -> Operand:
        """A · b."""
        return self.sum(*zip(a, b, strict=True))

    def cross(self, a: Vector, b: Vector) -> Vector:
        """A × b."""
        out = []
        for i, j in ((1, 2), (2, 0), (0, 1)):
            first, second = self._product(a[i], b[j]), self._product(a[j], b[i])
            if isinstance(second, float):
                out.append(self.sum(first, -second))
            elif isinstance(first, float):
                out.append(self.sum(first, (-1.0, self._named(second))))
            else:
                out.append(self.let(f"{first} - {second}"))
        return out

    def _product(self, a: Operand, b: Operand) -> Operand:
        """A product as an expression, or a number."""
        if isinstance(a, str) and isinstance(b, str):
            return f"{a} * {b}"
        if isinstance(a, float) and isinstance(b, float):
            return a * b
        number, name = (a, b) if isinstance(a, float) else (b, a)
        if number == 0.0:
            return 0.0
        return name if number == 1.0 else f"{literal(number)} * {name}"

    def _named(self, expression: str) -> str:
        return self.let(expression) if "*" in expression else expression

    def transform(self, matrix: Matrix, vector: Sequence[float], origin: Vector | None = None) -> Vector:
        """Origin + M v, M by its columns, v known."""
        origin = [0.0, 0.0, 0.0] if origin is None else origin
        return [
            self.sum(origin[i], *((float(v), column[i]) for v, column in zip(vector, matrix, strict=True)))
            for i in range(3)
        ]

    def times(self, matrix: Matrix, fixed: np.ndarray) -> Matrix:
        """M F by its columns, F ``[3, 3]`` known."""
        if np.array_equal(fixed, np.eye(3)):
            return matrix
        return [self.transform(matrix, known(column)) for column in fixed.T]


def function(name: str, lines: Lines) -> str:
    """A function of a world with these statements."""
    return f"FN void {name}(World& w) {{\n" + "\n".join(lines.statements) + "\n}"
