# SPDX-License-Identifier: Apache-2.0
"""Baked source of the norms of residuals."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ...bake.lines import Operand, Vector, text
from ...bake.number import decay, log_two, two_to
from ...kernels.terms import norms

if TYPE_CHECKING:
    from ..code.state import TermCode


def norm(code: TermCode, residual: Vector, p: Any) -> Operand:
    """``norms.norm_total`` of the sum of ``norms.norm_part``.

    Args:
        code: Where it is written.
        residual: The residual's numbers.
        p: The term's parameters, whose field ``norm`` is the norm.
    """
    kind, lines = int(p.norm.kind), code.lines
    if kind in (int(norms.QUADRATIC), int(norms.L22)):
        total = lines.dot(residual, residual)
        if kind == int(norms.QUADRATIC):
            return lines.sum((0.5, total))
        length = lines.let(f"VSQRT({text(total)})")
        return _rounded(code, length, p.norm.q)
    part = {
        int(norms.COSH): _cosh,
        int(norms.POWER): _power,
        int(norms.SMOOTH_ABS2): lambda code, x: _rounded(code, _size(code, x), p.norm.q),
        int(norms.RECTIFY): _rectify,
    }[kind]
    return lines.sum(*(part(code, text(x)) for x in residual))


def _bend(code: TermCode) -> str:
    return f"{code.params}.norm.p"


def _size(code: TermCode, x: str) -> str:
    return code.lines.let(f"VABS({x})")


def _defined(code: TermCode, name: str, statement: str) -> str:
    code.lines.add(statement)
    return name


def _to_the_power(code: TermCode, base: str, exponent: str) -> str:
    """base^exponent, of a base that is not negative."""
    base = code.lines.let(f"VMAX({base}, 1.0e-37f)")
    log = _defined(code, f"log_{base}", log_two(base, f"log_{base}"))
    return _defined(code, f"power_{base}", two_to(f"{exponent} * {log}", f"power_{base}"))


def _rounded(code: TermCode, x: str, q: float) -> str:
    """``norms.rounded``."""
    lines, p = code.lines, _bend(code)
    if q == 2.0:
        return lines.let(f"{x} * {x} / (VSQRT({x} * {x} + {p} * {p}) + {p})")
    most = lines.let(f"VMAX({x}, {p})")
    share = _to_the_power(code, f"VMIN({x}, {p}) / {most}", f"{code.params}.norm.q")
    root = _to_the_power(code, f"1.0f + {share}", f"(1.0f / {code.params}.norm.q)")
    return lines.let(f"{most} * {root} - {p}")


def _cosh(code: TermCode, x: str) -> str:
    lines, p = code.lines, _bend(code)
    half = lines.let(f"0.5f * VABS({x}) / {p}")
    small = _defined(code, f"small_{half}", decay(half, f"small_{half}"))
    large = lines.let(f"0.5f / {small} - 0.5f * {small}")
    # next to zero the difference of exponentials has few digits
    square = lines.let(f"{half} * {half}")
    series = f"{half} * (1.0f + {square} * ({1 / 6}f + {square} * ({1 / 120}f + {square} * {1 / 5040}f)))"
    root = lines.let(f"VSELECT({half} < 0.5f, {series}, {large})")
    return lines.let(f"2.0f * {p} * {p} * {root} * {root}")


def _power(code: TermCode, x: str) -> str:
    size = _size(code, x)
    return code.lines.let(f"VSELECT({size} > 1.0e-37f, {_to_the_power(code, size, _bend(code))}, 0.0f)")


def _rectify(code: TermCode, x: str) -> str:
    lines, p = code.lines, _bend(code)
    away = lines.let(f"VABS({x}) / {p}")
    small = _defined(code, f"small_{away}", decay(away, f"small_{away}"))
    more = lines.let(f"1.0f + {small}")
    log = _defined(code, f"log_{more}", log_two(more, f"log_{more}"))
    return lines.let(f"VMAX({x}, 0.0f) + {p} * 0.69314718f * {log}")
