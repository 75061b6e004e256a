# SPDX-License-Identifier: Apache-2.0
"""Statements of a Warp function: branches become selects, loops are written out or stay loops of C.

``return``, ``continue`` and ``break`` are assignments to ``%done``, ``%skip`` and ``%stop``, which branches merge like
any variable; the rest of a block is guarded by them.
"""

from __future__ import annotations

import ast
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

from .accessors import Accessors
from .values import (
    Array,
    Mat,
    Num,
    Params,
    PoseSymbol,
    Refused,
    Rot,
    Step,
    StructSymbol,
    Time,
    Vec,
    flat,
    plain,
    shaped,
)

BLOCK = 40
"""A branch of more statements is jumped over where no lane takes it."""
UNROLL = 12
"""Loops of more iterations stay loops, where their number is an index of parameters alone."""
TURNS = 100000
"""Turns after which a ``while`` ends whatever its condition: a lane that is not a number must not hang a plan."""

OPERATORS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Mod: "%", ast.FloorDiv: "//"}
UNWRITTEN = (Refused, TypeError, AttributeError, IndexError, KeyError, ValueError)
"""Errors of something that cannot be written as it was tried."""


class Statements(Accessors, ABC):
    """Writes the statements of a function; a subclass evaluates expressions (:meth:`value`)."""

    @abstractmethod
    def value(self, node: ast.expr, env: dict) -> Any:
        """Evaluate an expression."""

    def block(self, body: list[ast.stmt], env: dict) -> None:
        """Write statements, the rest of them guarded once some lanes have left."""
        for i, statement in enumerate(body):
            self.statement(statement, env)
            left = self.both(self.both(env["%done"], env["%skip"], "|"), env["%stop"], "|")
            if left is True:
                return
            if left is not False and i + 1 < len(body):
                self.branch(self.no(left), body[i + 1 :], [], env)
                return

    def statement(self, node: ast.stmt, env: dict) -> None:
        """Write one statement.

        Raises:
            Refused: If it is of a kind that terms do not need.
        """
        if isinstance(node, ast.Expr):
            if not isinstance(node.value, ast.Constant):  # a docstring
                self.value(node.value, env)
        elif isinstance(node, ast.Assign):
            self.assign(node.targets[0], self.value(node.value, env), env)
        elif isinstance(node, ast.AnnAssign):
            self.assign(node.target, self.value(node.value, env), env)
        elif isinstance(node, ast.AugAssign):
            old = self.value(ast.parse(ast.unparse(node.target), mode="eval").body, env)
            self.assign(node.target, self.binary(OPERATORS[type(node.op)], old, self.value(node.value, env)), env)
        elif isinstance(node, ast.If):
            self.branch(self.value(node.test, env), node.body, node.orelse, env)
        elif isinstance(node, ast.Return):
            env["%result"], env["%done"] = self.value(node.value, env) if node.value else None, True
        elif isinstance(node, ast.Continue):
            env["%skip"] = True
        elif isinstance(node, ast.Break):
            env["%stop"] = True
        elif isinstance(node, ast.For):
            self.loop(node, env)
        elif isinstance(node, ast.While):
            self.repeat(node, env)
        elif not isinstance(node, ast.Pass):
            raise Refused(type(node).__name__.lower())

    def branch(self, c: Any, body: list[ast.stmt], orelse: list[ast.stmt], env: dict) -> None:
        """Write both sides of a branch and merge what they assign; one side where the condition is known."""
        known = c if plain(c) else c.known
        if known is not None:
            self.block(body if known else orelse, env)
            return
        sides = []
        for negated, statements in ((False, body), (True, orelse)):
            side = dict(env)
            self.guarded(lambda own=side, lines=statements: self.block(lines, own), c, negated, env, side)
            sides.append(side)
        for name in sides[0] | sides[1]:
            a, b = (side.get(name) for side in sides)
            env[name] = self.merge(c, a, b) if a is not b else a

    def guarded(self, write: Callable[[], None], c: Num, negated: bool, before: dict, after: dict) -> None:
        """Write statements, jumped over where no lane needs them if they are many."""
        memo, outer = dict(self.out.memo), self.out.statements
        self.out.statements = inner = []
        write()
        self.out.statements = outer
        if len(inner) < BLOCK:
            outer.extend(inner)
            return
        kept: list[str] = []
        for name, x in after.items():
            if x is not before.get(name):
                after[name] = self._keep(x, before.get(name), kept)
        some = c.text if c.kind == "m" else f"VANY({c.text})"
        if negated:
            some = f"!({c.text})" if c.kind == "m" else f"VANY({c.text} == 0)"
        outer.extend([f"if ({some}) {{", *inner, *kept, "}"])
        self.out.memo = memo

    def _keep(self, x: Any, old: Any, kept: list[str]) -> Any:
        """Return a value that a block computes as variables that are there after it."""
        if x is None or x is old or plain(x) or isinstance(x, Params | Array | Step | Time):
            return x
        if isinstance(x, Vec):
            olds = old.x if isinstance(old, Vec) else [None] * len(x.x)
            return Vec(tuple(self._keep(y, o, kept) for y, o in zip(x.x, olds, strict=True)))
        if isinstance(x, Mat):
            return Mat(tuple(tuple(self._keep(y, None, kept) for y in row) for row in x.rows))
        if isinstance(x, Rot):
            return Rot(tuple(tuple(self._keep(y, None, kept) for y in column) for column in x.columns))
        if isinstance(x, PoseSymbol):
            return PoseSymbol(self._keep(self.rot(x), None, kept), self._keep(self.pos(x), None, kept))
        if isinstance(x, StructSymbol):
            olds = dict(old.fields) if isinstance(old, StructSymbol) else {}
            return StructSymbol(tuple((name, self._keep(y, olds.get(name), kept)) for name, y in x.fields))
        name, kind = self.out.fresh(), {"S": "T", "i": "I", "M": "I", "m": "bool"}.get(x.kind, x.kind)
        self.out.add(f"{kind} {name} = ({kind})0;")
        kept.append(f"{name} = {x.text};")
        self.out.names.add(name)
        return Num(name, {"S": "T", "i": "I"}.get(x.kind, x.kind))

    def loop(self, node: ast.For, env: dict) -> None:
        """Write a loop out, or as a loop of C where it has many iterations."""
        bounds = [self.value(a, env) for a in node.iter.args]
        fixed = all(map(plain, bounds))
        if any(not plain(bound) and self.kind(bound) != "i" for bound in bounds):
            raise Refused("a loop whose length differs between worlds")
        if fixed and (len(range(*bounds)) <= UNROLL or not self._rolled_if_it_can(node, bounds, env)):
            stop = env["%stop"]
            self._iterate(node, list(range(*bounds)), env)
            env["%stop"] = stop
        elif not fixed:
            try:
                self._rolled(node, bounds, env)
            except UNWRITTEN as error:
                raise Refused(f"a loop of unknown length: {error}") from error

    def _rolled_if_it_can(self, node: ast.For, bounds: list, env: dict) -> bool:
        """Write a loop of C; take its statements back where it cannot be one."""
        out, memo, length = self.out.statements, dict(self.out.memo), len(self.out.statements)
        try:
            self._rolled(node, bounds, env)
        except UNWRITTEN:
            self.out.statements, self.out.memo = out, memo
            del out[length:]
            return False
        return True

    def _rolled(self, node: ast.For, bounds: list, env: dict) -> None:
        if len(bounds) > 2:
            raise Refused("a loop with a step")
        own = self._carried(node.body, env)
        first, last = ([0, *bounds] if len(bounds) == 1 else bounds)[:2]
        i = self.out.fresh()
        head = f"for (int {i} = {self.raw(first)}; {i} < {self.raw(last)}; ++{i}) {{"
        self._body(head, node.body, env | own | {node.target.id: Num(i, "i"), "%skip": False}, own, None)
        env |= own

    def repeat(self, node: ast.While, env: dict) -> None:
        """Write a ``while`` that goes on until no lane does; lanes that are done keep what they have."""
        own = self._carried(node.body, env)
        self._body(f"for (int turn = 0; turn < {TURNS}; ++turn) {{", node.body, env | own, own, node.test)
        env |= own

    def _body(self, head: str, body: list[ast.stmt], inner: dict, own: dict, test: ast.expr | None) -> None:
        """Write a loop of C around statements that change carried variables."""
        outer, memo = self.out.statements, self.out.memo
        self.out.statements, self.out.memo = [], dict(memo)
        done, stop = inner["%done"], inner["%stop"]
        go = None if test is None else self.value(test, inner)
        if plain(go):
            raise Refused("a loop whose condition never changes")
        if go is not None:
            self.out.add(f"if (!{go.text if go.kind == 'm' else f'VANY({go.text})'}) break;")
        self.block(body, inner)
        if inner["%done"] is not done or inner["%stop"] is not stop:
            raise Refused("return or break in a loop that stays one")
        for name, x in own.items():
            for to, y in zip(flat(x), flat(inner[name]), strict=True):
                if y is not to:
                    new = self.lanes(y)
                    self.out.add(f"{to.text} = {new if go is None else f'VSELECT({go.text}, {new}, {to.text})'};")
        inside, self.out.statements, self.out.memo = self.out.statements, outer, memo
        outer.extend([head, *inside, "}"])

    def _carried(self, body: list[ast.stmt], env: dict) -> dict:
        """Return variables of a loop's body that were there before it, as variables that may change."""
        changed = {name for s in body for n in ast.walk(s) for name in _assigned(n)} & env.keys()
        out: dict = {}
        for name in sorted(changed):
            if not isinstance(env[name], Num | Vec | Mat | float | int):
                raise Refused(f"{name} changes in a loop")
            fresh = []
            for x in flat(env[name]):
                own = self.out.fresh()
                self.out.add(f"T {own} = {self.lanes(x)};")
                self.out.names.add(own)
                fresh.append(Num(own))
            out[name] = shaped(fresh, env[name])
        return out

    def _iterate(self, node: ast.For, left: list[int], env: dict) -> None:
        """Write iterations, one after the other, the rest of them guarded once some lanes have left."""
        for n, i in enumerate(left):
            env[node.target.id], env["%skip"] = i, False
            self.block(node.body, env)
            env["%skip"] = False
            out = self.both(env["%done"], env["%stop"], "|")
            if out is True:
                return
            if out is not False:
                go, inner = self.no(out), env | {"%done": False, "%stop": False}
                self.guarded(lambda own=inner, m=n: self._iterate(node, left[m + 1 :], own), go, False, env, inner)
                for name, x in inner.items():
                    env[name] = self.merge(go, x, env.get(name)) if x is not env.get(name) else x
                return

    def assign(self, target: ast.expr, x: Any, env: dict) -> None:
        """Assign to a variable, an entry of a vector or matrix, or a field of a struct."""
        if isinstance(target, ast.Name):
            env[target.id] = x
        elif isinstance(target, ast.Tuple):
            for one, y in zip(target.elts, x, strict=True):
                self.assign(one, y, env)
        elif isinstance(target, ast.Attribute) and isinstance(target.value, ast.Name):
            self._assign_field(target.value.id, target.attr, x, env)
        elif isinstance(target, ast.Subscript) and isinstance(target.value, ast.Name):
            self._assign_entry(target.value.id, self.value(target.slice, env), x, env)
        else:
            raise Refused(f"{ast.unparse(target)} = ...")

    def _assign_field(self, name: str, field: str, x: Any, env: dict) -> None:
        old = env[name]
        if isinstance(old, Step) and field == "t" and isinstance(x, Time):
            env[name] = Step(x.back)
        elif isinstance(old, StructSymbol):
            env[name] = StructSymbol(tuple({**dict(old.fields), field: x}.items()))
        else:
            raise Refused(f"{name}.{field} = ...")

    def _assign_entry(self, name: str, at: Any, x: Any, env: dict) -> None:
        old, at = env[name], at if isinstance(at, tuple) else (at,)
        if not all(map(plain, at)):
            raise Refused(f"an entry of {name} by an index that is not known")
        if isinstance(old, Vec):
            env[name] = Vec((*old.x[: at[0]], x, *old.x[at[0] + 1 :]))
        elif isinstance(old, Mat):
            rows = [list(row) for row in old.rows]
            rows[at[0]] = list(x.x) if len(at) == 1 else [*rows[at[0]][: at[1]], x, *rows[at[0]][at[1] + 1 :]]
            env[name] = Mat(tuple(map(tuple, rows)))
        else:
            raise Refused(f"{name}[...] = ...")


def _assigned(node: ast.AST) -> list[str]:
    targets = node.targets if isinstance(node, ast.Assign) else []
    if isinstance(node, ast.AugAssign | ast.AnnAssign):
        targets = [node.target]
    return [next(n.id for n in ast.walk(target) if isinstance(n, ast.Name)) for target in targets]
