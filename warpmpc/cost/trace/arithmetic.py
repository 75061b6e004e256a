# SPDX-License-Identifier: Apache-2.0
"""Operators on symbols: sums, comparisons, masks, and values merged where branches meet."""

from __future__ import annotations

import math
import operator
from typing import Any

import numpy as np

from ...physics.runtime.bake import literal
from ..code.state import StateCode
from .values import Mat, Num, PoseSymbol, Refused, Rot, Shared, StructSymbol, Time, Vec, plain, value

PYTHON = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
    "%": math.fmod,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
}
"""Operators of C as Python has them."""
LARGEST = 1e30
"""Bound of literals: an infinite one would be undefined where a compiler may assume that numbers are finite."""
INTEGERS = frozenset("Iik")
UNIFORM = frozenset("Sikf")


class Arithmetic:
    """Writes operators.

    Args:
        out: Takes the statements.
        state: Source of the state that the term reads.
    """

    def __init__(self, out: Shared, state: StateCode):
        self.out, self.state, self.layout = out, state, state.layout

    def operand(self, x: Any) -> str | float:
        """Return a number as an operand of ``bake``."""
        if plain(x):
            return float(min(max(float(x), -LARGEST), LARGEST))
        if isinstance(x, Num):
            return {"I": f"VFLOAT({x.text})", "i": f"(float)({x.text})"}.get(x.kind, x.text)
        raise Refused(f"a {type(x).__name__} where a number is needed")

    def lanes(self, x: Any) -> str:
        """Return a number as a name or a literal of type ``T``."""
        x = self.operand(x)
        if isinstance(x, float):
            return f"((T){literal(x)})"
        return x if x in self.out.names or x.replace("_", "").isalnum() else self.out.let(x)

    def one(self, x: Any) -> str:
        """Return a number as a literal in C, or as the operand that it is."""
        return literal(float(min(max(x, -LARGEST), LARGEST))) if plain(x) else self.operand(x)

    def symbol(self, x: Any) -> Any:
        """Return an operand of ``bake`` as a symbol."""
        return x if plain(x) else Num(x)

    def vector(self, operands: Any) -> Vec:
        """Return operands as a vector."""
        return Vec(tuple(map(self.symbol, operands)))

    def rotation(self, columns: Any) -> Rot:
        """Return columns of operands as a rotation."""
        return Rot(tuple(tuple(map(self.symbol, column)) for column in columns))

    def raw(self, x: Any) -> str:
        """Return an int or a float as C writes it."""
        if isinstance(x, Time):
            return f"(at + {1 - x.back})"
        if isinstance(x, bool | int | np.integer):
            return str(int(x))
        return literal(min(max(x, -LARGEST), LARGEST)) if plain(x) else x.text

    def kind(self, x: Any) -> str:
        """Return the kind of a number: those of :class:`Num`, ``k`` and ``f`` for an int and a float of Python."""
        if isinstance(x, Time):
            return "i"
        if isinstance(x, Num):
            return x.kind
        if not plain(x):
            raise Refused(f"a {type(x).__name__} where a number is needed")
        return "k" if isinstance(x, bool | int | np.integer) else "f"

    def binary(self, op: str, a: Any, b: Any) -> Any:
        """Write a sum, difference, product, quotient or remainder; ``//`` and ``%`` of ints follow C."""
        if plain(a) and plain(b):
            return self._known(op, a, b)
        if isinstance(a, Time) and op == "-" and plain(b):
            return Time(a.back + int(b))
        if isinstance(a, Vec | Mat | Rot | PoseSymbol) or isinstance(b, Vec | Mat | Rot | PoseSymbol):
            return self._composite(op, a, b)
        kinds = {self.kind(a), self.kind(b)}
        if kinds <= INTEGERS:
            if (op, b) in (("+", 0), ("*", 1), ("-", 0)):
                return a
            kind = "I" if "I" in kinds else "i"
            return Num(self.out.let(f"{self.raw(a)} {'/' if op == '//' else op} {self.raw(b)}", kind), kind)
        return self._float(op, a, b, kinds)

    def _known(self, op: str, a: Any, b: Any) -> Any:
        whole = isinstance(a, int) and isinstance(b, int)
        if op == "//" or (op == "/" and whole):
            found = math.trunc(a / b)
            return found if whole else float(found)
        return int(math.fmod(a, b)) if op == "%" and whole else PYTHON[op](a, b)

    def _float(self, op: str, a: Any, b: Any, kinds: set[str]) -> Any:
        for x, sign in ((a, 1), (b, -1 if op == "-" else 1)):  # limits that there are not
            if plain(x) and math.isinf(x) and op in "+-":
                return sign * x
        if (op in "+-" and plain(b) and b == 0) or (op in "*/" and plain(b) and b == 1):
            return a
        if (op == "+" and plain(a) and a == 0) or (op == "*" and plain(a) and a == 1):
            return b
        if (op in "*/" and plain(a) and a == 0) or (op == "*" and plain(b) and b == 0) or (op == "-" and a == b):
            return 0.0
        if op in ("//", "%"):
            raise Refused(f"{op} of floats")
        if kinds <= UNIFORM:
            known = value(a), value(b)
            found = None if None in known or (op == "/" and known[1] == 0) else PYTHON[op](*known)
            parts = (f"(float){self.raw(x)}" if self.kind(x) == "i" else self.one(x) for x in (a, b))
            return Num(self.out.let(f" {op} ".join(parts), "S"), "S", found)
        if op == "-" and plain(a) and a == 0:
            return Num(self.out.let(f"-{self.lanes(b)}"))
        return Num(self.out.let(f"{self.one(a)} {op} {self.one(b)}"))

    def _composite(self, op: str, a: Any, b: Any) -> Any:
        each = self.binary
        if isinstance(a, Vec) and isinstance(b, Vec) and op in "+-":
            return Vec(tuple(each(op, x, y) for x, y in zip(a.x, b.x, strict=True)))
        if isinstance(a, Vec) and not isinstance(b, Vec | Mat) and op in "*/":
            return Vec(tuple(each(op, x, b) for x in a.x))
        if isinstance(b, Vec) and op == "*" and not isinstance(a, Vec | Mat):
            return Vec(tuple(each(op, a, x) for x in b.x))
        if isinstance(a, Mat) and isinstance(b, Mat) and op in "+-":
            rows = zip(a.rows, b.rows, strict=True)
            return Mat(tuple(tuple(each(op, x, y) for x, y in zip(*pair, strict=True)) for pair in rows))
        if op == "*" and isinstance(a, Mat) and isinstance(b, Vec):
            return Vec(tuple(self.dot(Vec(row), b) for row in a.rows))
        if op == "*" and isinstance(a, Mat) and isinstance(b, Mat):
            columns = list(zip(*b.rows, strict=True))
            return Mat(tuple(tuple(self.dot(Vec(row), Vec(column)) for column in columns) for row in a.rows))
        if isinstance(a, Mat) and op in "*/":
            return Mat(tuple(tuple(each(op, x, b) for x in row) for row in a.rows))
        if op == "*" and isinstance(b, Mat):
            return Mat(tuple(tuple(each(op, a, x) for x in row) for row in b.rows))
        if op == "*" and isinstance(a, Rot) and isinstance(b, Rot):
            return Rot(tuple(self.rotate(a, Vec(column)).x for column in b.columns))
        if op == "*" and isinstance(a, PoseSymbol) and isinstance(b, PoseSymbol):
            return PoseSymbol(self.binary("*", self.rot(a), self.rot(b)), self.point(a, self.pos(b)))
        raise Refused(f"{type(a).__name__} {op} {type(b).__name__}")

    def compare(self, op: str, a: Any, b: Any) -> Any:
        """Write a comparison: a mask, or a bool where all lanes agree or the outcome is known."""
        if value(a) is not None and value(b) is not None:
            return bool(PYTHON[op](value(a), value(b)))
        kinds = {self.kind(a), self.kind(b)}
        kind = "M" if kinds & {"T", "I"} else "m"
        if kinds <= INTEGERS or kind == "m":
            return Num(self.out.let(f"{self.raw(a)} {op} {self.raw(b)}", kind), kind)
        return Num(self.out.let(f"{self.one(a)} {op} {self.one(b)}", kind), kind)

    def both(self, a: Any, b: Any, op: str) -> Any:
        """Write the logical ``&`` or ``|`` of two conditions."""
        for x, y in ((a, b), (b, a)):
            if plain(x):
                return y if bool(x) == (op == "&") else op == "|"
        if a == b:
            return a
        kind = "M" if "M" in (a.kind, b.kind) else "m"
        texts = (f"(VSELECT({x.text}, 1.0f, 0.0f) > 0.5f)" if x.kind != kind else x.text for x in (a, b))
        return Num(self.out.let(f" {op} ".join(texts), kind), kind)

    def no(self, a: Any) -> Any:
        """Write the negation of a condition; not by ``~``, which is true of any bool on a GPU."""
        return (not a) if plain(a) else Num(self.out.let(f"{a.text} == 0", a.kind), a.kind)

    def merge(self, c: Any, a: Any, b: Any) -> Any:
        """Write ``a`` where a condition holds, else ``b``."""
        if plain(c):
            return a if c else b
        if a is b or (type(a) is type(b) and a == b):
            return a
        if a is None or b is None:  # defined on one side alone
            return a if b is None else b
        if isinstance(a, bool) or isinstance(b, bool) or "M" in (getattr(a, "kind", ""), getattr(b, "kind", "")):
            return self.both(self.both(c, a, "&"), self.both(self.no(c), b, "&"), "|")
        if type(a) is not type(b) and not {type(a), type(b)} <= {Num, int, float}:
            raise Refused("branches that leave a variable with values of different types")
        if isinstance(a, Vec):
            return Vec(self._merged(c, a.x, b.x))
        if isinstance(a, Mat):
            return Mat(tuple(self._merged(c, *pair) for pair in zip(a.rows, b.rows, strict=True)))
        if isinstance(a, Rot):
            return Rot(tuple(self._merged(c, *pair) for pair in zip(a.columns, b.columns, strict=True)))
        if isinstance(a, PoseSymbol):
            return PoseSymbol(self.merge(c, self.rot(a), self.rot(b)), self.merge(c, self.pos(a), self.pos(b)))
        if isinstance(a, StructSymbol):
            pairs = zip(a.fields, b.fields, strict=True)
            return StructSymbol(tuple((name, self.merge(c, x, y)) for (name, x), (_, y) in pairs))
        if {self.kind(a), self.kind(b)} <= INTEGERS:
            return Num(self.out.let(f"{c.text} ? (I)({self.raw(a)}) : (I)({self.raw(b)})", "I"), "I")
        return Num(self.out.let(f"VSELECT({c.text}, {self.lanes(a)}, {self.lanes(b)})"))

    def _merged(self, c: Any, a: tuple, b: tuple) -> tuple:
        return tuple(self.merge(c, x, y) for x, y in zip(a, b, strict=True))

    def negative(self, x: Any) -> Any:
        """Write -x."""
        if isinstance(x, Vec):
            return Vec(tuple(map(self.negative, x.x)))
        if isinstance(x, Mat):
            return Mat(tuple(tuple(map(self.negative, row)) for row in x.rows))
        if isinstance(x, Rot):  # the same rotation
            return Rot(x.columns, x.quaternion and tuple(map(self.negative, x.quaternion)))
        if plain(x):
            return -x
        known = None if x.known is None else -x.known
        return Num(self.out.let(f"-{x.text}", x.kind), x.kind, known)

    def sum(self, *terms: Any) -> Any:
        """Write Σ of operands and of products of two operands."""
        return self.symbol(self.out.sum(*terms))

    def dot(self, a: Vec, b: Vec) -> Any:
        """Write a · b."""
        return self.sum(*((self.operand(x), self.operand(y)) for x, y in zip(a.x, b.x, strict=True)))

    def rotate(self, r: Rot, v: Vec) -> Vec:
        """Write R v."""
        columns = r.columns
        return Vec(
            tuple(
                self.sum(*((self.operand(x), self.operand(c[k])) for x, c in zip(v.x, columns, strict=True)))
                for k in range(3)
            )
        )

    def rotate_back(self, r: Rot, v: Vec) -> Vec:
        """Write Rᵀ v."""
        return Vec(tuple(self.dot(Vec(column), v) for column in r.columns))

    def rot(self, p: PoseSymbol) -> Rot:
        """Return the rotation of a pose."""
        return self.rotation(self.state.body_columns(p.body)) if p.rot is None else p.rot

    def pos(self, p: PoseSymbol) -> Vec:
        """Return the position of a pose."""
        return self.vector(self.state.body_point(p.body, np.zeros(3))) if p.pos is None else p.pos

    def point(self, p: PoseSymbol, v: Vec) -> Vec:
        """Write a point that is given in a pose's frame; points of bodies that terms share are written once."""
        at = [value(x) for x in v.x]
        if p.body is not None and None not in at:
            return self.vector(self.state.body_point(p.body, np.array(at)))
        return self.binary("+", self.pos(p), self.rotate(self.rot(p), v))
