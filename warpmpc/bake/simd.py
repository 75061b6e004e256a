# SPDX-License-Identifier: Apache-2.0
"""The SIMD type ``T`` of baked source: one float on a GPU, several samples at once on a CPU."""

from __future__ import annotations

import platform

import numpy as np

from .lines import literal

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
