# SPDX-License-Identifier: Apache-2.0
"""Baked source of residuals in space."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ...bake.lines import Operand, Vector
from .norms import norm

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ...bake.state import TermCode


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


def _spatial(code: TermCode, p: Any, vector: list[Operand]) -> Operand:
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
