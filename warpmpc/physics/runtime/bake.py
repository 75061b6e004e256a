# SPDX-License-Identifier: Apache-2.0
"""Straight-line source over a SIMD type ``T``: one float on a GPU, 16, 8 or 4 samples at once on a CPU.

Operands are names of C variables or Python floats. What is known when the source is written (a robot's dimensions,
zeros and ones of its frames) is folded into it. The source of the controls of one step is a sum of few knots.
"""

from __future__ import annotations

import platform
from collections.abc import Sequence

import numpy as np

from ...kernels.engine.launch import TAPS

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


NAMES = (
    "VMAX",
    "VMIN",
    "VABS",
    "VSQRT",
    "VROUND",
    "VFLOOR",
    "VANY",
    "VINT",
    "VFLOAT",
    "VLOAD",
    "VSTORE",
    "VGATHER",
    "VSELECT",
    "VTWO",
    "VEXPONENT",
)
"""Operations of baked source on a ``T`` besides arithmetic: macros, undefined again before they are defined."""

_ONE = """
typedef float T;
typedef int I;
#define VMAX(a, b) fmaxf(a, b)
#define VMIN(a, b) fminf(a, b)
#define VABS(a) fabsf(a)
#define VSQRT(a) sqrtf(a)
#define VROUND(a) rintf(a)
#define VFLOOR(a) floorf(a)
#define VANY(m) (m)
#define VINT(a) ((int)(a))
#define VFLOAT(a) ((float)(a))
#define VLOAD(p) (*(const float*)(p))
#define VSTORE(p, x) (*(float*)(p) = (x))
#define VGATHER(p, i) ((p)[i])
#define VSELECT(m, a, b) ((m) ? (a) : (b))
#define VTWO(k) exp2f(k)
#define VEXPONENT(x) rintf(log2f(x))
"""

_MANY = """
typedef float T __attribute__((ext_vector_type(LANES)));
typedef int I __attribute__((ext_vector_type(LANES)));
struct __attribute__((packed, aligned(4))) TU { T v; };
#define VMAX(a, b) __builtin_elementwise_max((T)(a), (T)(b))
#define VMIN(a, b) __builtin_elementwise_min((T)(a), (T)(b))
#define VABS(a) __builtin_elementwise_abs(a)
#define VSQRT(a) __builtin_elementwise_sqrt(a)
#define VROUND(a) __builtin_elementwise_rint(a)
#define VFLOOR(a) __builtin_elementwise_floor(a)
#define VANY(m) (__builtin_reduce_or(m) != 0)
#define VINT(a) __builtin_convertvector(a, I)
#define VFLOAT(a) __builtin_convertvector(a, T)
#define VLOAD(p) (((const TU*)(p))->v)
#define VSTORE(p, x) (((TU*)(p))->v = (x))
#define VSELECT(m, a, b) ((m) ? (T)(a) : (T)(b))
#define VTWO(k) __builtin_bit_cast(T, (VINT(k) + 127) << 23)
#define VEXPONENT(x) VFLOAT((__builtin_bit_cast(I, x) - 0x3f3504f3) >> 23)
static const auto VGATHER = [](const float* p, I i) -> T {
GATHER
T r; for (int l = 0; l < LANES; ++l) r[l] = p[i[l]]; return r;
};
"""

_GATHER = {
    16: ("__AVX512F__", "(T)__builtin_ia32_gathersiv16sf((T)0.0f, p, i, (unsigned short)0xffff, 4)"),
    8: ("__AVX2__", "(T)__builtin_ia32_gatherd_d256((I)0, (const int*)p, i, (I)-1, 4)"),
}
"""Feature of a processor with one instruction that reads so many floats, and that instruction."""


def header(lanes: int) -> str:
    """Definition of ``T`` and of the macros in :data:`NAMES`.

    Args:
        lanes: Samples in a ``T`` on a CPU.
    """
    undo = "\n".join(f"#undef {name}" for name in NAMES)
    feature, gather = _GATHER.get(lanes, ("", ""))
    gather = f"#if defined({feature})\nreturn {gather};\n#endif" if gather else ""
    many = _MANY.replace("GATHER\nT r;", f"{gather}\nT r;").replace("LANES", str(lanes))
    return f"{undo}\n#if defined(__CUDA_ARCH__)\n{_ONE}#else\n{many}#endif\n"


def _series() -> tuple[np.ndarray, np.ndarray]:
    """Sin t = t P(t²), cos t = Q(t²) for |t| ≤ π/2, interpolated at Chebyshev nodes; both to 1e-8."""
    t = (np.pi / 2) * np.cos(np.pi * (np.arange(400) + 0.5) / 400)
    t = t[np.abs(t) > 1e-3]
    fit = np.polynomial.polynomial.polyfit
    return fit(t * t, np.sin(t) / t, 5), fit(t * t, np.cos(t), 6)


def sincos(angle: str, sine: str, cosine: str, *, half: tuple[str, str] | None = None) -> str:
    """Statements that define sine and cosine of an angle, without branches.

    The angle is reduced to [-π, π]; polynomials give sine and cosine of its half, double-angle formulas the rest.

    Args:
        angle: Name of the angle [rad].
        sine: Name of its sine.
        cosine: Name of its cosine.
        half: Names of sine and cosine of its half, which have the sign of the reduced angle.
    """
    s, c = _series()
    turns = f"const T k = VROUND({angle} * {literal(0.5 / np.pi)})"
    # 2π in two parts, the first of few digits: k times it is exact
    reduced = f"const T y = ({angle} - k * 6.28125f) - k * {literal(2 * np.pi - 6.28125)}"
    kept = f" {half[0]} = a; {half[1]} = b;" if half else ""
    names = ", ".join((sine, cosine, *(half or ())))
    return (
        f"T {names};\n"
        f"{{ {turns}; {reduced}; const T t = 0.5f * y; const T w = t * t;"
        f" const T a = t * {horner(s, 'w')}; const T b = {horner(c, 'w')};"
        f" {sine} = 2.0f * a * b; {cosine} = 1.0f - 2.0f * a * a;{kept} }}"
    )


def horner(k: np.ndarray, x: str) -> str:
    """A polynomial, its coefficients from the lowest power on."""
    return "".join(f"({literal(a)} + {x} * " for a in k[:-1]) + literal(k[-1]) + ")" * (len(k) - 1)


def two_to(y: str, name: str) -> str:
    """Statements that define 2^y, y between -126 and 126 or taken for these, to a few units in the last place.

    Args:
        y: An expression.
        name: Name of the result.
    """
    f = 0.5 * np.cos(np.pi * (np.arange(200) + 0.5) / 200)
    power = horner(np.polynomial.polynomial.polyfit(f, 2.0**f, 6), "f")
    whole = f"const T y = VMIN(VMAX({y}, -126.0f), 126.0f); const T k = VROUND(y)"
    return f"T {name}; {{ {whole}; const T f = y - k; {name} = VTWO(k) * {power}; }}"


def log_two(x: str, name: str) -> str:
    """Statements that define the logarithm of a positive value to the base 2, to 2e-7 next to 1.

    Args:
        x: Name of the value, above 1e-38.
        name: Name of the result.
    """
    low, high = 2.0**-0.5 - 1.001, 2.0**0.5 - 0.999
    d = 0.5 * (low + high) + 0.5 * (high - low) * np.cos(np.pi * (np.arange(400) + 0.5) / 400)
    series = horner(np.polynomial.polynomial.polyfit(d, np.log2(1.0 + d) / d, 10), "d")
    return f"T {name}; {{ const T k = VEXPONENT({x}); const T d = {x} * VTWO(-k) - 1.0f; {name} = k + d * {series}; }}"


def angle(sine: str, cosine: str, name: str) -> str:
    """Statements that define the angle in [0, π/2] of a point whose coordinates are not negative, to 1e-6 rad.

    Args:
        sine: Name of its height.
        cosine: Name of its distance from the upright axis.
        name: Name of the result.
    """
    t = 0.5 + 0.5 * np.cos(np.pi * (np.arange(400) + 0.5) / 400)
    series = horner(np.polynomial.polynomial.polyfit(t * t, np.arctan(t) / t, 8), "w")
    least = f"const T low = VMIN({sine}, {cosine}), high = VMAX({sine}, {cosine})"
    small = f"const T t = low / VMAX(high, 1.0e-30f); const T w = t * t; const T a = t * {series}"
    return f"T {name}; {{ {least}; {small}; {name} = VSELECT({sine} > {cosine}, {literal(np.pi / 2)} - a, a); }}"


def direction(height: str, width: str, name: str) -> str:
    """Statements that define the angle in [-π, π] of a point in the plane, 0 at the origin, to 1e-6 rad.

    Args:
        height: Name of its second coordinate, or an expression.
        width: Name of its first coordinate, or an expression.
        name: Name of the result.
    """
    first = angle("rise", "run", "part")
    return (
        f"T {name}; {{ const T rise = VABS({height}), run = VABS({width}); {first}"
        f" part = VSELECT({width} < 0.0f, {literal(np.pi)} - part, part);"
        f" {name} = VSELECT({height} < 0.0f, -part, part); }}"
    )


def native_lanes() -> int:
    """Samples that a register of this CPU holds: 16 with AVX-512, 8 with AVX, else 4."""
    if platform.machine() != "x86_64":  # emulated processors may show their host's flags
        return 4
    try:
        with open("/proc/cpuinfo") as file:
            flags = next((line for line in file if line.startswith("flags")), "").split()
    except OSError:
        return 4
    return 16 if "avx512f" in flags else 8 if "avx" in flags else 4


WIDE = " -mprefer-vector-width=512"
"""Compiler flag for 16 lanes: without it LLVM splits them into two registers."""


CONTROL = f"""const int* tap = (const int*)k.tap.data + (e * steps + at) * {int(TAPS)};
const float* share = (const float*)k.share.data + (e * steps + at) * {int(TAPS)};"""
"""Knots that the step's control depends on, and how much."""
