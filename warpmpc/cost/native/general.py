# SPDX-License-Identifier: Apache-2.0
"""Baked source of general terms: distances, heights, joints, controls."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ...bake.lines import Operand, Vector, text
from ...bake.number import angle, decay, direction
from .paths import detour

if TYPE_CHECKING:
    from ..code.state import TermCode


def length(code: TermCode, v: Vector) -> str:
    """‖v‖."""
    return code.lines.let(f"VSQRT({text(code.lines.dot(v, v))})")


def squares(code: TermCode, values: list[str]) -> Operand:
    """Σ x²."""
    return code.lines.sum(*((x, x) for x in values))


def beyond(code: TermCode, value: str, bound: str) -> str:
    """By how much the size of a value exceeds a bound."""
    return code.lines.let(f"VMAX(VABS({value}) - {bound}, 0.0f)")


def fading(code: TermCode, away: str, near: str) -> str:
    """exp(-away / near)."""
    share = code.lines.let(f"{away} / {near}")
    left = f"left_{share}"
    code.lines.add(decay(share, left))
    return left


def distance(code: TermCode, p: Any) -> Operand:
    """``general.distance``."""
    state, lines = code.state, code.lines
    first, second = state.frame(p.first), state.frame(p.second)
    at = first.position
    if p.lead > 0.0:
        velocity, _ = state.velocity(p.first)
        at = [lines.sum(x, (f"{code.params}.lead", v)) for x, v in zip(at, velocity, strict=True)]
    d = lines.difference(at, second.position)
    away = length(code, d[:2] + [0.0] if p.planar else d)
    if p.field >= 0:
        away = lines.let(f"{away} + {detour(code, p.field, at)}")
    return away if p.near == 0.0 else lines.let(f"1.0f - {fading(code, away, f'{code.params}.near')}")


def yaw_error(code: TermCode, p: Any) -> Operand:
    """``general.yaw_error``: the angle between the x axes, seen from above."""
    lines, a, b = code.lines, code.state.frame(p.of), code.state.frame(p.to)
    (ax, ay, _), (bx, by, _) = ([text(x) for x in frame.columns[0]] for frame in (a, b))
    sine, cosine = lines.let(f"{ay} * {bx} - {ax} * {by}"), lines.let(f"{ax} * {bx} + {ay} * {by}")
    turn = f"turn_{sine}"
    lines.add(direction(sine, cosine, turn))
    error = lines.let(f"VABS({turn})")
    if p.smooth > 0.0:
        error = lines.let(f"VSQRT({error} * {error} + {code.params}.smooth * {code.params}.smooth)")
        error = lines.let(f"{error} - {code.params}.smooth")
    if p.near == 0.0:
        return error
    away = length(code, [*lines.difference(a.position, b.position)[:2], 0.0])
    return lines.let(f"{error} * {fading(code, away, f'{code.params}.near')}")


def contact_cost(code: TermCode, p: Any) -> Operand:
    """``general.contact_cost``."""
    pairs = range(p.first, p.first + p.count)
    return code.lines.sum(*(length(code, code.state.force(pair)) for pair in pairs))


def orientation(code: TermCode, p: Any) -> Operand:
    """``general.orientation``: twice the angle whose sine and cosine are those of half the turn."""
    lines, (a, b) = code.lines, (code.state.frame(i).columns for i in (p.of, p.to))
    if p.tilt:
        # unit vectors: half their difference and half their sum
        total = [lines.sum(x, y) for x, y in zip(a[2], b[2], strict=True)]
        sine, cosine = length(code, lines.difference(a[2], b[2])), length(code, total)
    else:
        # Σ ‖R_a e_i - R_b e_i‖² = 8 sin²(θ/2)
        miss = [x for pair in zip(a, b, strict=True) for x in lines.difference(*pair)]
        squared = lines.let(f"0.125f * {text(squares(code, [text(x) for x in miss]))}")
        sine, cosine = lines.let(f"VSQRT({squared})"), lines.let(f"VSQRT(VMAX(1.0f - {squared}, 0.0f))")
    half = f"half_{sine}"
    lines.add(angle(sine, cosine, half))
    return lines.let(f"2.0f * {half}")


def height(code: TermCode, p: Any) -> Operand:
    """``general.height``."""
    z = code.state.frame(p.of).position[2]
    error = f"VABS({text(z)} - {code.params}.target) - {code.params}.slack"
    return code.lines.let(f"VMAX({error}, 0.0f)")


def joint_limit(code: TermCode, p: Any) -> Operand:
    """``general.joint_limit``."""
    outside = []
    for n, i in enumerate(p.coord.numpy()):
        q = code.state.coordinate(int(i))
        below, above = f"{code.params}.lower.data[{n}] - {q}", f"{q} - {code.params}.upper.data[{n}]"
        outside.append(code.lines.let(f"VMAX(VMAX({below}, {above}), 0.0f)"))
    return squares(code, outside)


def joint_velocity(code: TermCode, p: Any) -> Operand:
    """``general.joint_velocity_cost``."""
    speeds = [code.state.speed(int(dof)) for dof in p.joint.numpy()]
    return squares(code, [v for v in speeds if isinstance(v, str)])


def posture(code: TermCode, p: Any) -> Operand:
    """``general.posture``."""
    coords = [code.state.coordinate(int(i)) for i in p.coord.numpy()]
    return squares(code, [code.lines.let(f"{q} - {code.params}.target.data[{n}]") for n, q in enumerate(coords)])


def control_effort(code: TermCode, p: Any) -> Operand:
    """``general.control_effort``."""
    controls = range(p.first, p.first + p.count)
    return squares(code, [code.lines.let(f"c{u} / s.control_scale.data[{u}]") for u in controls])


def control_rate(code: TermCode, p: Any) -> Operand:
    """``general.control_rate``."""
    controls = range(p.first, p.first + p.count)
    return squares(code, [code.lines.let(f"(c{u} - d{u}) / s.control_scale.data[{u}]") for u in controls])
