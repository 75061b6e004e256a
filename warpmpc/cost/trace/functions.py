# SPDX-License-Identifier: Apache-2.0
"""Warp's functions on symbols; a method ``wp_NAME`` stands for ``wp.NAME``."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partialmethod
from typing import Any

from ...physics.runtime import bake
from ...physics.runtime.bake import literal
from .arithmetic import INTEGERS, Arithmetic
from .values import Mat, Num, PoseSymbol, Refused, Rot, Vec, plain, value


class Functions(Arithmetic):
    """Writes calls of Warp's functions."""

    def defined(self, write: Callable[..., str], *args: str) -> Num:
        """Write a function of ``bake``, once for the same arguments."""
        key = f"{write.__name__}({', '.join(args)})"
        if key not in self.out.memo:
            self.out.memo[key] = name = self.out.fresh()
            self.out.add(write(*args, name))
        return Num(self.out.memo[key])

    def sincos(self, x: Any) -> tuple[Any, Any]:
        """Write sine and cosine."""
        if plain(x):
            return math.sin(x), math.cos(x)
        name = self.lanes(x)
        key = f"sincos({name})"
        if key not in self.out.memo:
            self.out.memo[key] = own = self.out.fresh()
            self.out.add(bake.sincos(name, f"{own}s", f"{own}c"))
        own = self.out.memo[key]
        return Num(f"{own}s"), Num(f"{own}c")

    def extreme(self, macro: str, fold: Callable, a: Any, b: Any) -> Any:
        """Write the smaller or the larger of two values, entry by entry."""
        if isinstance(a, Vec):
            return Vec(tuple(self.extreme(macro, fold, x, y) for x, y in zip(a.x, b.x, strict=True)))
        if plain(a) and plain(b):
            return fold(a, b)
        for x, y in ((a, b), (b, a)):
            if plain(x) and math.isinf(x):  # the smaller of a number and infinity is the number
                return y if (x > 0) == (fold is min) else x
        kinds = {self.kind(a), self.kind(b)}
        if kinds <= INTEGERS:
            sign, kind = "<" if fold is min else ">", "I" if "I" in kinds else "i"
            cast = "(I)" if kind == "I" else ""
            one, two = (f"{cast}({self.raw(x)})" for x in (a, b))
            return Num(self.out.let(f"{one} {sign} {two} ? {one} : {two}", kind), kind)
        return Num(self.out.let(f"{macro}({self.one(a)}, {self.one(b)})"))

    def wp_abs(self, x: Any) -> Any:
        if plain(x):
            return abs(x)
        if x.kind in "Ii":
            return self.extreme("VMAX", max, x, self.negative(x))
        return Num(self.out.let(f"VABS({self.lanes(x)})"))

    def wp_min(self, a: Any, b: Any) -> Any:
        return self.extreme("VMIN", min, a, b)

    def wp_max(self, a: Any, b: Any) -> Any:
        return self.extreme("VMAX", max, a, b)

    def wp_clamp(self, x: Any, low: Any, high: Any) -> Any:
        return self.wp_min(self.wp_max(x, low), high)

    def wp_sqrt(self, x: Any) -> Any:
        return math.sqrt(x) if plain(x) else Num(self.out.let(f"VSQRT({self.lanes(x)})"))

    def wp_exp(self, x: Any) -> Any:
        if plain(x):
            return math.exp(x)
        return self.defined(bake.two_to, f"{literal(1.0 / math.log(2.0))} * {self.lanes(x)}")

    def _log_two(self, x: Any) -> Num:
        return self.defined(bake.log_two, self.lanes(self.wp_max(x, 1e-37)))

    def wp_log(self, x: Any) -> Any:
        return math.log(x) if plain(x) else self.binary("*", math.log(2.0), self._log_two(x))

    def wp_pow(self, a: Any, b: Any) -> Any:
        if plain(a) and plain(b):
            return math.pow(a, b)
        if plain(b) and float(b).is_integer() and 1 <= b <= 4:
            out = a
            for _ in range(int(b) - 1):
                out = self.binary("*", out, a)
            return out
        return self.defined(bake.two_to, self.lanes(self.binary("*", b, self._log_two(a))))

    def wp_sin(self, x: Any) -> Any:
        return self.sincos(x)[0]

    def wp_cos(self, x: Any) -> Any:
        return self.sincos(x)[1]

    def wp_tan(self, x: Any) -> Any:
        return self.binary("/", *self.sincos(x))

    def wp_atan2(self, y: Any, x: Any) -> Any:
        if plain(y) and plain(x):
            return math.atan2(y, x)
        return self.defined(bake.direction, self.lanes(y), self.lanes(x))

    def wp_atan(self, x: Any) -> Any:
        return self.wp_atan2(x, 1.0)

    def _leg(self, x: Any) -> Any:
        """√(1 - x²)."""
        square = self.binary("*", self.binary("-", 1.0, x), self.binary("+", 1.0, x))
        return self.wp_sqrt(self.wp_max(square, 0.0))

    def wp_acos(self, x: Any) -> Any:
        return self.wp_atan2(self._leg(x), x)

    def wp_asin(self, x: Any) -> Any:
        return self.wp_atan2(x, self._leg(x))

    def wp_sinh(self, x: Any) -> Any:
        if plain(x):
            return math.sinh(x)
        size = self.wp_abs(x)
        small = self.wp_exp(self.negative(size))
        large = self.binary("-", self.binary("/", 0.5, small), self.binary("*", 0.5, small))
        h = self.lanes(size)
        square = self.out.let(f"{h} * {h}")
        terms = f"({literal(1 / 6)} + {square} * ({literal(1 / 120)} + {square} * {literal(1 / 5040)}))"
        series = Num(self.out.let(f"{h} * (1.0f + {square} * {terms})"))
        root = self.merge(self.compare("<", size, 0.5), series, large)
        return self.merge(self.compare("<", x, 0.0), self.negative(root), root)

    def wp_cosh(self, x: Any) -> Any:
        e = self.wp_exp(x)
        return self.binary("*", 0.5, self.binary("+", e, self.binary("/", 1.0, e)))

    def wp_tanh(self, x: Any) -> Any:
        e = self.wp_exp(self.binary("*", 2.0, x))
        return self.binary("-", 1.0, self.binary("/", 2.0, self.binary("+", e, 1.0)))

    def wp_floor(self, x: Any) -> Any:
        return math.floor(x) if plain(x) else Num(self.out.let(f"VFLOOR({self.lanes(x)})"))

    def wp_rint(self, x: Any) -> Any:
        return float(round(x)) if plain(x) else Num(self.out.let(f"VROUND({self.lanes(x)})"))

    wp_round = wp_rint

    def wp_sign(self, x: Any) -> Any:
        return self.merge(self.compare("<", x, 0.0), -1.0, 1.0)  # 1 at 0, as Warp has it

    def wp_step(self, x: Any) -> Any:
        return self.merge(self.compare("<", x, 0.0), 1.0, 0.0)

    wp_where = Arithmetic.merge

    def wp_isfinite(self, x: Any) -> Any:
        raise Refused("wp.isfinite: a launch may assume that numbers are finite")

    wp_isnan = wp_isinf = wp_isfinite

    def wp_lerp(self, a: Any, b: Any, t: Any) -> Any:
        rest = self.binary("-", 1.0, t)
        return self.binary("+", self.binary("*", a, rest), self.binary("*", b, t))

    def wp_smoothstep(self, a: Any, b: Any, x: Any) -> Any:
        t = self.wp_clamp(self.binary("/", self.binary("-", x, a), self.binary("-", b, a)), 0.0, 1.0)
        return self.binary("*", self.binary("*", t, t), self.binary("-", 3.0, self.binary("*", 2.0, t)))

    def wp_length_sq(self, v: Any) -> Any:
        if isinstance(v, Rot):
            v = Vec(self.quaternion(v))
        return self.dot(v, v)

    def wp_length(self, v: Any) -> Any:
        return self.wp_sqrt(self.wp_length_sq(v))

    def wp_normalize(self, v: Any) -> Any:
        if isinstance(v, Rot):
            return v
        size = self.wp_length(v)
        return self.binary("/", v, self.wp_max(size, 1e-30))

    def wp_dot(self, a: Any, b: Any) -> Any:
        if isinstance(a, Rot):
            a, b = Vec(self.quaternion(a)), Vec(self.quaternion(b))
        return self.dot(a, b)

    def wp_cross(self, a: Vec, b: Vec) -> Vec:
        return self.vector(self.out.cross(*([self.operand(x) for x in v.x] for v in (a, b))))

    def wp_outer(self, a: Vec, b: Vec) -> Mat:
        return Mat(tuple(tuple(self.binary("*", x, y) for y in b.x) for x in a.x))

    def wp_cw_mul(self, a: Vec, b: Vec) -> Vec:
        return Vec(tuple(self.binary("*", x, y) for x, y in zip(a.x, b.x, strict=True)))

    def wp_cw_div(self, a: Vec, b: Vec) -> Vec:
        return Vec(tuple(self.binary("/", x, y) for x, y in zip(a.x, b.x, strict=True)))

    def wp_transpose(self, m: Mat) -> Mat:
        return Mat(tuple(zip(*m.rows, strict=True)))

    def wp_identity(self, n: int, dtype: Any) -> Mat:
        return Mat(tuple(tuple(float(i == j) for j in range(n)) for i in range(n)))

    def quaternion(self, r: Rot) -> tuple:
        """Write the components (x, y, z, w) of a rotation, w not negative."""
        if r.quaternion is not None:
            return r.quaternion
        (a, b, c), (d, e, f), (g, h, i) = r.columns
        out = []
        for first, second, third, more, less in ((a, e, i, f, h), (e, a, i, g, c), (i, a, e, b, d)):
            rest = self.binary("+", second, third)
            square = self.wp_max(self.binary("+", 1.0, self.binary("-", first, rest)), 0.0)
            size = self.binary("*", 0.5, self.wp_sqrt(square))
            out.append(self.merge(self.compare("<", self.binary("-", more, less), 0.0), self.negative(size), size))
        trace = self.binary("+", self.binary("+", a, e), i)
        w = self.binary("*", 0.5, self.wp_sqrt(self.wp_max(self.binary("+", 1.0, trace), 0.0)))
        return (*out, w)

    def wp_quat(self, *parts: Any) -> Rot:
        if len(parts) == 2:  # a vector and a number
            parts = (*parts[0].x, parts[1])
        if not parts:
            parts = (0.0, 0.0, 0.0, 0.0)
        x, y, z, w = parts

        def twice(a: Any, b: Any, op: str, c: Any, d: Any) -> Any:
            return self.binary("*", 2.0, self.binary(op, self.binary("*", a, b), self.binary("*", c, d)))

        columns = (
            (self.binary("-", 1.0, twice(y, y, "+", z, z)), twice(x, y, "+", z, w), twice(x, z, "-", y, w)),
            (twice(x, y, "-", z, w), self.binary("-", 1.0, twice(x, x, "+", z, z)), twice(y, z, "+", x, w)),
            (twice(x, z, "+", y, w), twice(y, z, "-", x, w), self.binary("-", 1.0, twice(x, x, "+", y, y))),
        )
        return Rot(columns, (x, y, z, w))

    wp_quat_rotate, wp_quat_rotate_inv = Arithmetic.rotate, Arithmetic.rotate_back

    def wp_quat_inverse(self, q: Rot) -> Rot:
        x = q.quaternion
        parts = None if x is None else (*map(self.negative, x[:3]), x[3])
        return Rot(tuple(zip(*q.columns, strict=True)), parts)

    def wp_quat_to_matrix(self, q: Rot) -> Mat:
        return Mat(tuple(zip(*q.columns, strict=True)))

    def wp_quat_identity(self) -> Rot:
        return Rot(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (0.0, 0.0, 0.0, 1.0))

    def wp_quat_from_axis_angle(self, axis: Vec, angle: Any) -> Rot:
        s, c = self.sincos(self.binary("*", 0.5, angle))
        return self.wp_quat(*(self.binary("*", s, x) for x in axis.x), c)

    def wp_quat_from_matrix(self, m: Mat) -> Rot:
        return Rot(tuple(zip(*m.rows, strict=True)))

    def wp_transform(self, p: Vec, q: Rot) -> PoseSymbol:
        return PoseSymbol(q, p)

    def wp_transform_identity(self) -> PoseSymbol:
        return PoseSymbol(self.wp_quat_identity(), Vec((0.0, 0.0, 0.0)))

    wp_transform_get_translation, wp_transform_get_rotation = Arithmetic.pos, Arithmetic.rot
    wp_transform_point = Arithmetic.point

    def wp_transform_vector(self, p: PoseSymbol, v: Vec) -> Vec:
        return self.rotate(self.rot(p), v)

    def wp_transform_multiply(self, a: PoseSymbol, b: PoseSymbol) -> PoseSymbol:
        return self.binary("*", a, b)

    def wp_transform_inverse(self, p: PoseSymbol) -> PoseSymbol:
        turn = self.rot(p)
        return PoseSymbol(self.wp_quat_inverse(turn), self.negative(self.rotate_back(turn, self.pos(p))))

    def wp_spatial_top(self, v: Vec) -> Vec:
        return Vec(v.x[:3])

    def wp_spatial_bottom(self, v: Vec) -> Vec:
        return Vec(v.x[3:])

    def vec(self, n: int, *x: Any) -> Vec:
        """Return a vector of ``n`` numbers, of one number ``n`` times, or of zeros."""
        if len(x) == 1 and isinstance(x[0], Vec):
            return x[0]
        return Vec(x if len(x) == n else (x or (0.0,)) * n)

    def mat(self, n: int, *x: Any) -> Mat:
        """Return a square matrix of its numbers row by row, of one number everywhere, or of zeros."""
        x = x if len(x) == n * n else (x or (0.0,)) * (n * n)
        return Mat(tuple(x[n * i : n * i + n] for i in range(n)))

    wp_vec2, wp_vec3, wp_vec4 = partialmethod(vec, 2), partialmethod(vec, 3), partialmethod(vec, 4)
    wp_vec2f, wp_vec3f, wp_vec4f = wp_vec2, wp_vec3, wp_vec4
    wp_mat22, wp_mat33, wp_spatial_matrix = partialmethod(mat, 2), partialmethod(mat, 3), partialmethod(mat, 6)

    def wp_spatial_vector(self, *x: Any) -> Vec:
        return Vec(x[0].x + x[1].x) if x and isinstance(x[0], Vec) else self.vec(6, *x)

    def wp_float(self, x: Any) -> Any:
        if plain(x):
            return float(x)
        if x.kind not in "Ii":
            return x
        kind = "T" if x.kind == "I" else "S"
        return Num(self.out.let(self.operand(x), kind), kind, x.known)

    def wp_int(self, x: Any) -> Any:
        if plain(x):
            return int(x)
        if x.kind in "Ii":
            return x
        if x.kind == "T":
            return Num(self.out.let(f"VINT({self.lanes(x)})", "I"), "I")
        return Num(self.out.let(f"(int)({x.text})", "i"), "i", value(x) and int(value(x)))

    wp_float32, wp_int32 = wp_float, wp_int

    def wp_bool(self, x: Any) -> Any:
        return bool(x) if plain(x) else self.compare("!=", x, 0)
