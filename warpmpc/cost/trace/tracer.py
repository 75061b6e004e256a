# SPDX-License-Identifier: Apache-2.0
"""Traces one cost term: expressions, calls, and the parameters that it reads."""

from __future__ import annotations

import ast
import builtins
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ...kernels.cost import points, view
from .statements import OPERATORS, UNWRITTEN, Statements
from .values import (
    Array,
    Mat,
    Num,
    Params,
    Refused,
    Rot,
    Shared,
    States,
    Step,
    StructSymbol,
    Time,
    Vec,
    constant,
    plain,
    zero_of,
)

if TYPE_CHECKING:
    from ...physics.runtime.bake import Operand
    from ..code.state import TermCode

COMPARISONS = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="}


def trace(code: TermCode, function: wp.Function, params: Any) -> Operand:
    """Write a term's function as source.

    Args:
        code: Where the source is written, and what it may ask about the state.
        function: ``(s: StepView, p: Params) -> float``.
        params: The filled parameter struct; branches and loops that it decides are decided now.

    Returns:
        The term's value.

    Raises:
        Refused: If the function does what cannot be traced, or asks for a part of the state that the engine's source
            does not have; the message says what.
    """
    return Tracer(code).run(function, params)


class Tracer(Statements):
    """Evaluates the syntax tree of a Warp function on symbols.

    Args:
        code: Where the source is written, and what it may ask about the state.
    """

    def __init__(self, code: TermCode):
        out = Shared(f"{code.lines.prefix}x")
        super().__init__(out, code.state)
        self._code = code
        if code.lines is not code.state.lines:
            out.statements = code.lines.statements
        own = {getattr(view, name[5:]): getattr(self, name) for name in dir(self) if name.startswith("view_")}
        own[points.point_velocity] = self.point_velocity
        self._accessors = own
        self._arrays: dict[int, np.ndarray] = {}

    def run(self, function: wp.Function, params: Any) -> Operand:
        """Write the function; returns its value."""
        try:
            found = self.call(function, [Step(), Params(params, self._code.params)], {})
            value = self.operand(found)
        except UNWRITTEN as error:
            if isinstance(error, Refused):
                raise
            raise Refused(f"{type(error).__name__}: {error}") from error
        if self._code.lines is self._code.state.lines:  # what the state has written comes first
            self._code.lines.statements.extend(self.out.statements)
        return value

    def call(self, function: wp.Function, args: list, kwargs: dict) -> Any:
        """Write a call of a Warp function.

        Raises:
            Refused: If it is native code, or asks for a frame, a joint or the like by an index that is not known.
        """
        if function in self._accessors:
            if any(isinstance(a, Num) and a.kind in "iI" for a in args[1:]):
                raise Refused(f"{function.key} of an index that is not known")
            return self._accessors[function](*args, **kwargs)
        if function.func is None or function.native_snippet is not None:
            raise Refused(f"{function.key} is native code")
        tree = function.adj.tree.body[0]
        names = [a.arg for a in tree.args.args]
        env = {"%function": function.func, "%done": False, "%skip": False, "%stop": False, "%result": None}
        env |= dict(zip(names, args, strict=False)) | kwargs
        self.block(tree.body, env)
        return env["%result"]

    def value(self, node: ast.expr, env: dict) -> Any:
        """Evaluate an expression.

        Raises:
            Refused: If it is of a kind that terms do not need.
        """
        if isinstance(node, ast.Constant):
            return node.value
        if isinstance(node, ast.Name):
            return env[node.id] if node.id in env else self._global(node.id, env["%function"])
        if isinstance(node, ast.Tuple):
            return tuple(self.value(x, env) for x in node.elts)
        if isinstance(node, ast.Attribute):
            return self._attribute(self.value(node.value, env), node.attr)
        if isinstance(node, ast.Subscript):
            return self._item(self.value(node.value, env), self.value(node.slice, env))
        if isinstance(node, ast.BinOp):
            if type(node.op) not in OPERATORS:
                raise Refused(type(node.op).__name__.lower())
            return self.binary(OPERATORS[type(node.op)], self.value(node.left, env), self.value(node.right, env))
        if isinstance(node, ast.UnaryOp):
            x = self.value(node.operand, env)
            return (
                self.no(x) if isinstance(node.op, ast.Not) else self.negative(x) if isinstance(node.op, ast.USub) else x
            )
        if isinstance(node, ast.Compare):
            return self._comparison(node, env)
        if isinstance(node, ast.BoolOp):
            return self._logical(node, env)
        if isinstance(node, ast.IfExp):
            return self.merge(self.value(node.test, env), self.value(node.body, env), self.value(node.orelse, env))
        if isinstance(node, ast.Call):
            function = self.value(node.func, env)
            args = [self.value(a, env) for a in node.args]
            kwargs = {k.arg: self.value(k.value, env) for k in node.keywords}
            return self.call(function, args, kwargs) if isinstance(function, wp.Function) else function(*args, **kwargs)
        raise Refused(type(node).__name__.lower())

    def _comparison(self, node: ast.Compare, env: dict) -> Any:
        out, left = True, self.value(node.left, env)
        for op, right in zip(node.ops, node.comparators, strict=True):
            if type(op) not in COMPARISONS:
                raise Refused(type(op).__name__.lower())
            right = self.value(right, env)
            out, left = self.both(out, self.compare(COMPARISONS[type(op)], left, right), "&"), right
        return out

    def _logical(self, node: ast.BoolOp, env: dict) -> Any:
        sign, out = ("&", True) if isinstance(node.op, ast.And) else ("|", False)
        for x in node.values:
            out = self.both(out, self.value(x, env), sign)
            if plain(out) and bool(out) != (sign == "&"):
                return out
        return out

    def _global(self, name: str, function: Any) -> Any:
        """Return what a name stands for in a function's closure, its module or Python."""
        if name in ("int", "float", "bool", "min", "max", "abs"):
            return getattr(self, f"wp_{name}")
        cells = dict(zip(function.__code__.co_freevars, function.__closure__ or (), strict=True))
        if name in cells:
            return self._made(cells[name].cell_contents)
        return self._made(function.__globals__.get(name, getattr(builtins, name, None)))

    def _made(self, x: Any) -> Any:
        """Return a type as what makes a value of it, a constant of Warp as its number."""
        if isinstance(x, type) and hasattr(x, "_wp_generic_type_str_"):
            own = getattr(self, f"wp_{x.__name__}", None) or getattr(self, f"wp_{x.__name__.removesuffix('f')}", None)
            if own is None and x._wp_generic_type_str_ == "vec_t":
                return partial(self.vec, x._length_)
            if own is None:
                raise Refused(x.__name__)
            return own
        if hasattr(x, "vars") and hasattr(x, "cls"):
            return lambda: StructSymbol(tuple((name, zero_of(var.type)) for name, var in x.vars.items()))
        return x

    def _attribute(self, x: Any, name: str) -> Any:
        if x is wp:
            own = getattr(self, f"wp_{name}", None)
            found = getattr(wp, name, None)
            if own is None and isinstance(found, type):
                return self._made(found)
            if own is None and not plain(found):
                raise Refused(f"wp.{name}")
            return found if own is None else own
        if isinstance(x, Step):
            return {"t": Time(x.back), "e": Num("e", "i"), "w": None}[name] if len(name) == 1 else States(name)
        if isinstance(x, States) and name == "shape":
            return self.shape(x.name)
        if isinstance(x, Params):
            return constant(getattr(x.value, name), f"{x.text}.{name}")
        if isinstance(x, Array) and name == "shape":
            return list(x.value.shape)
        if isinstance(x, StructSymbol):
            return dict(x.fields)[name]
        if isinstance(x, Vec) and name in "xyzw":
            return x.x["xyzw".index(name)]
        if isinstance(x, Num | Vec | Mat | Rot):
            raise Refused(f".{name} of a {type(x).__name__}")
        return self._made(getattr(x, name))

    def _item(self, x: Any, at: Any) -> Any:
        if isinstance(x, list):
            return x[at]
        at = at if isinstance(at, tuple) else (at,)
        if isinstance(x, States):
            return self.states(x.name, at)
        if isinstance(x, Array):
            return self._read(x, at)
        if not all(map(plain, at)):
            raise Refused("an entry of a vector by an index that is not known")
        if isinstance(x, Vec):
            return x.x[at[0]]
        if isinstance(x, Rot):
            return self.quaternion(x)[at[0]]
        if isinstance(x, Mat):
            return Vec(x.rows[at[0]]) if len(at) == 1 else x.rows[at[0]][at[1]]
        raise Refused(f"an entry of a {type(x).__name__}")

    def _numbers(self, array: wp.array) -> np.ndarray:
        if id(array) not in self._arrays:
            self._arrays[id(array)] = array.numpy()
        return self._arrays[id(array)]

    def _read(self, x: Array, at: tuple) -> Any:
        """Write an entry of an array of parameters; indices are clamped where a lane that diverged computes them."""
        array, shape = x.value, x.value.shape
        if all(map(plain, at)):
            return constant(self._numbers(array)[at], x.text, array.dtype, int(np.ravel_multi_index(at, shape)))
        index: Any = 0
        for i, size in zip(at, shape, strict=True):
            index = self.binary("+", self.binary("*", index, int(size)), i)
        varies = index.kind == "I"
        if varies:
            index = self.wp_clamp(index, 0, int(np.prod(shape)) - 1)
        if array.dtype in (int, wp.int32):
            if varies:
                raise Refused("an int by an index that differs between worlds")
            return Num(self.out.let(f"((const int*){x.text}.data)[{index.text}]", "i"), "i")
        scalar = array.dtype in (float, wp.float32)
        if not scalar and getattr(array.dtype, "_wp_generic_type_str_", "") != "vec_t":
            raise Refused(f"an array of {array.dtype.__name__} by an index that is not known")
        width, pointer, numbers = 1 if scalar else array.dtype._length_, f"((const float*){x.text}.data)", []
        for k in range(width):
            entry = self.raw(self.binary("+", self.binary("*", index, width), k))
            if varies:
                numbers.append(Num(self.out.let(f"VGATHER({pointer}, {entry})")))
            else:
                numbers.append(Num(self.out.let(f"{pointer}[{entry}]", "S"), "S"))
        return numbers[0] if scalar else Vec(tuple(numbers))
