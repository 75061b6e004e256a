# SPDX-License-Identifier: Apache-2.0
"""Residual terms in space: how their keys in scene files become kernel parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..kernels.terms import residuals as costs
from ..scene.errors import SceneError
from .native import residuals as native
from .places import place_points, points_struct
from .residual_keys import CentreOfMass, Position, Velocity
from .term import CostTerm, Residual, parse_keys

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .binding import Binding
    from .places import Point
    from .residual_keys import SpatialResidual


def wanted(target: Sequence[float | str] | None, count: int, b: Binding) -> costs.Wanted:
    """What each of a residual's numbers shall be.

    Raises:
        SceneError: If there are neither one nor as many as numbers, or a scalar does not exist.
    """
    target = (0.0,) if target is None else target
    if len(target) not in (1, count):
        raise SceneError(f"needs 1 or {count} values", key=f"{b.key}.target", file=b.file, found=list(target))
    if len(target) < count:
        target = target * count
    out = costs.Wanted()
    scalars = [b.scalar(value, "target") if isinstance(value, str) else -1 for value in target]
    out.scalar = b.array(scalars, dtype=int)
    out.value = b.array([0.0 if isinstance(value, str) else value for value in target], dtype=float)
    return out


def _spatial(v: SpatialResidual, points: list[Point], b: Binding) -> costs.SpatialParams:
    frames = [part for place in (v.of, getattr(v, "relative_to", None)) for part in place or ()]
    flat = [part for part in frames if not isinstance(part, CentreOfMass) and part in b.scene.flat_poses]
    if v.axes and "z" in v.axes and flat:
        raise SceneError(
            "this pose has no height: give it three coordinates, or leave z out",
            key=f"{b.key}.axes",
            file=b.file,
            found=flat[0],
        )
    axes = ["xyz".index(axis) for axis in v.axes or ("xy" if flat else "xyz")]
    p = costs.SpatialParams()
    p.points, p.norm = points_struct(points, b), v.norm.struct()
    p.axis, p.wanted = b.array(np.array(axes), dtype=int), wanted(v.target, len(axes), b)
    return p


def _position(keys: dict[str, Any], b: Binding) -> costs.SpatialParams:
    v = parse_keys(Position, keys, b)
    points = [point.scaled(1.0, v.lead) for point in place_points(v.of, "of", b)]
    points += [point.scaled(-1.0) for point in place_points(v.relative_to or (), "relative_to", b)]
    return _spatial(v, points, b)


def _velocity(keys: dict[str, Any], b: Binding) -> costs.SpatialParams:
    v = parse_keys(Velocity, keys, b)
    points = place_points(v.of, "of", b)
    points += [point.scaled(-1.0) for point in place_points(v.relative_to or (), "relative_to", b)]
    return _spatial(v, points, b)


def _axes(p: costs.SpatialParams) -> int:
    return p.axis.shape[0]


TERMS = (
    CostTerm(
        "position_residual",
        costs.position_residual,
        costs.SpatialParams,
        _position,
        Position,
        native.position,
        residual=Residual(costs.position_component, _axes),
    ),
    CostTerm(
        "velocity_residual",
        costs.velocity_residual,
        costs.SpatialParams,
        _velocity,
        Velocity,
        native.velocity,
        residual=Residual(costs.velocity_component, _axes),
    ),
)
"""Residual terms in space."""
