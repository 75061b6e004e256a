# SPDX-License-Identifier: Apache-2.0
"""Small faults that lines of Python can have: a sign, comparison, branch, number, min and max, ``and`` and ``or``.

Texts, annotations, defaults, messages and what is raised have none.
"""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass

COMPARISONS = {"<": "<=", "<=": "<", ">": ">=", ">=": ">", "==": "!=", "!=": "=="}
SIGNS = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=", ast.Add: "+"}
EXTREMES = {"min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum"}
SPEAKERS = {"print", "echo", "secho", "info", "warning", "warn", "debug", "error", "exception", "log"}
"""Calls whose arguments are for a reader."""


@dataclass(frozen=True)
class Fault:
    """Text ``old`` of a line at a column that becomes ``new``."""

    path: str
    line: int
    column: int
    kind: str
    old: str
    new: str
    inside: str
    """Function around it."""
    text: str
    """The whole line, without blanks around it."""


def faults(path: str, source: str) -> list[Fault]:
    """Faults that a file can have."""
    lines, found = source.splitlines(), []

    def add(kind: str, start: tuple[int, int], end: tuple[int, int], pattern: str, new: str, inside: str) -> None:
        if start[0] == end[0]:
            raw = lines[start[0] - 1].encode()
            at, text = len(raw[: start[1]].decode()), raw[start[1] : end[1]].decode()
            if match := re.search(pattern, text):
                whole = lines[start[0] - 1].strip()
                column = at + match.start()
                found.append(Fault(path, start[0], column, kind, match[0], new.format(match[0]), inside, whole))

    def visit(node: ast.AST, inside: str) -> None:
        begin, end = lambda n: (n.lineno, n.col_offset), lambda n: (n.end_lineno, n.end_col_offset)
        match node:
            case ast.Raise() | ast.JoinedStr() | ast.arguments():
                return
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name):
                for child in [] if name in ("__repr__", "__str__") else node.body:
                    visit(child, name)
                return
            case ast.ClassDef():
                for child in node.body:
                    visit(child, inside or node.name)
                return
            case ast.AnnAssign(value=value) | ast.Assign(value=value):
                if value and not isinstance(value, ast.Constant):
                    visit(value, inside)
                return
            case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name)):
                if name in SPEAKERS:
                    return
                if name in EXTREMES:
                    add("min/max", begin(node), end(node.func), rf"\b{name}$", EXTREMES[name], inside)
            case ast.BinOp(op=ast.Add() | ast.Sub() as op, left=left, right=right):
                if not any(isinstance(x, ast.JoinedStr | ast.List | ast.Tuple) or _text(x) for x in (left, right)):
                    old, new = ("+", "-") if isinstance(op, ast.Add) else ("-", "+")
                    add("sign", end(left), begin(right), re.escape(old), new, inside)
            case ast.AugAssign(op=ast.Add() | ast.Sub() as op, target=target, value=value):
                old, new = ("+=", "-=") if isinstance(op, ast.Add) else ("-=", "+=")
                add("sign", end(target), begin(value), re.escape(old), new, inside)
            case ast.UnaryOp(op=ast.USub()):
                add("sign", begin(node), end(node), "^-", "", inside)
            case ast.Compare(ops=[op], left=left, comparators=[right]) if type(op) in SIGNS:
                old = SIGNS[type(op)]
                add("comparison", end(left), begin(right), re.escape(old), COMPARISONS[old], inside)
            case ast.BoolOp(op=op, values=[first, second, *_]):
                old, new = ("and", "or") if isinstance(op, ast.And) else ("or", "and")
                add("and/or", end(first), begin(second), rf"\b{old}\b", new, inside)
            case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
                new = str(value + 1) if isinstance(value, int) else repr(2.0 * value or 1.0)
                add("number", begin(node), end(node), ".+", new, inside)
        if isinstance(node, ast.If | ast.IfExp | ast.While):
            if ast.unparse(node.test) == "TYPE_CHECKING" or "__name__" in ast.unparse(node.test):
                return
            add("branch", begin(node.test), end(node.test), ".+", "(not ({}))", inside)
        for child in ast.iter_child_nodes(node):
            visit(child, inside)

    visit(ast.parse(source), "")
    return found


def _text(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)
