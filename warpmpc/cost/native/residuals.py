# SPDX-License-Identifier: Apache-2.0
"""Baked source of residuals in space."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ...bake.lines import Operand, Vector, text
from .norms import norm

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ..code.state import TermCode


def wanted(code: TermCode, p: Any, i: int) -> str:
    """``residuals.wanted``."""
    scalar = int(p.wanted.scalar.numpy()[i])
    return f"{code.params}.wanted.value.data[{i}]" if scalar < 0 else code.state.scalar(scalar)


def less_wanted(code: TermCode, values: Vector, p: Any) -> Vector:
    """Numbers less what they shall be."""
    return [code.lines.sum(x, (-1.0, wanted(code, p, i))) for i, x in enumerate(values)]


def _points(code: TermCode, p: Any) -> Iterator[tuple[int, np.ndarray, Operand, Operand]]:
    """Body, place in it, share and lead of each point."""
    points = p.points
    bodies, at, share, lead = (a.numpy() for a in (points.body, points.at, points.share, points.lead))
    for i, body in enumerate(bodies):
        # a whole frame's share is no draw
        known = float(share[i]) if abs(share[i]) == 1.0 else f"{code.params}.points.share.data[{i}]"
        yield int(body), at[i].astype(float), known, f"{code.params}.points.lead.data[{i}]" if lead[i] else 0.0


def _along(code: TermCode, p: Any, vector: Vector) -> Vector:
    """``residuals.along``."""
    if p.heading < 0:
        return vector
    lines, (x, y, _) = code.lines, code.state.frame(p.heading).columns[0]
    squared = text(lines.sum((x, x), (y, y)))
    scale = lines.let(f"1.0f / VMAX(VSQRT({squared}), 1.0e-6f)")
    cosine, sine = (lines.let(f"{scale} * {text(part)}") for part in (x, y))
    ahead = lines.sum((cosine, vector[0]), (sine, vector[1]))
    left = lines.sum((cosine, vector[1]), (lines.let(f"-{sine}"), vector[0]))
    return [ahead, left, vector[2]]


def _spatial(code: TermCode, p: Any, vector: list[Operand]) -> Operand:
    vector = _along(code, p, vector)
    values = [vector[axis] for axis in p.axis.numpy()]
    return norm(code, less_wanted(code, values, p), p)


def _sum(code: TermCode, vectors: list[tuple[Operand, Vector]]) -> Vector:
    """Σ share · vector."""
    return [code.lines.sum(*((share, v[k]) for share, v in vectors)) for k in range(3)]


def position(code: TermCode, p: Any) -> Operand:
    """``residuals.position_residual``."""
    parts = []
    for body, at, share, lead in _points(code, p):
        x = code.state.body_point(body, at)
        if lead != 0.0:
            velocity, _ = code.state.point_velocity(body, at)
            x = [code.lines.sum(a, (lead, v)) for a, v in zip(x, velocity, strict=True)]
        parts.append((share, x))
    return _spatial(code, p, _sum(code, parts))


def velocity(code: TermCode, p: Any) -> Operand:
    """``residuals.velocity_residual``."""
    parts = [(share, code.state.point_velocity(body, at)[0]) for body, at, share, _ in _points(code, p)]
    return _spatial(code, p, _sum(code, parts))


def angular_velocity(code: TermCode, p: Any) -> Operand:
    """``residuals.angular_velocity_residual``."""
    parts = [(share, code.state.point_velocity(body, at)[1]) for body, at, share, _ in _points(code, p)]
    return _spatial(code, p, _sum(code, parts))


def rotation(code: TermCode, p: Any) -> Operand:
    """``residuals.rotation_residual``."""
    a, b = code.state.frame(p.of).columns, code.state.frame(p.to).columns
    pairs = [(a[axis], b[axis]) for axis in p.axis.numpy()]
    values = [code.lines.sum((0.5**0.5, x)) for pair in pairs for x in code.lines.difference(*pair)]
    return norm(code, values, p)


def angular_momentum(code: TermCode, p: Any) -> Operand:
    """``residuals.angular_momentum_residual``."""
    state, lines, own = code.state, code.lines, replace(code, params=f"{code.params}.own")
    points = list(_points(own, p.own))
    at = [state.body_point(body, at) for body, at, _, _ in points]
    motion = [state.point_velocity(body, at) for body, at, _, _ in points]
    shares = [share for _, _, share, _ in points]
    centre = _sum(code, list(zip(shares, at, strict=True)))
    moving = _sum(code, [(share, linear) for share, (linear, _) in zip(shares, motion, strict=True)])
    parts = []
    for i, (body, *_) in enumerate(points):
        linear, angular = motion[i]
        columns, inertia = state.body_columns(body), f"{code.params}.inertia.data[{i}].data"
        spin = [lines.dot(column, angular) for column in columns]
        turned = [lines.sum(*((f"{inertia}[{k}][{m}]", spin[m]) for m in range(3))) for k in range(3)]
        parts.append((1.0, [lines.sum(*((turned[k], columns[k][axis]) for k in range(3))) for axis in range(3)]))
        lever = lines.cross(lines.difference(at[i], centre), lines.difference(linear, moving))
        parts.append((f"{code.params}.mass.data[{i}]", lever))
    return _spatial(own, p.own, _sum(code, parts))
