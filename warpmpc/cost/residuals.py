# SPDX-License-Identifier: Apache-2.0
"""Residual terms in space: how their keys in scene files become kernel parameters."""

from __future__ import annotations

from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..kernels.terms import residuals as costs
from ..scene.errors import SceneError
from .places import Point, massive, place_points, points_struct
from .residual_keys import (
    AngularVelocity,
    CentreOfMass,
    Momentum,
    Position,
    RotationKeys,
    SpatialResidual,
    Velocity,
)
from .term import CostTerm, Residual, parse_keys
from .wanted import wanted

if TYPE_CHECKING:
    from .binding import Binding


def _spatial(v: SpatialResidual | AngularVelocity | Momentum, points: list[Point], b: Binding) -> costs.SpatialParams:
    places = (v.of, v.relative_to or ()) if isinstance(v, Position) else ()
    flat = [part for place in places for part in place if isinstance(part, str) and part in b.scene.flat_poses]
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
    p.heading = b.frame(v.heading, "heading") if isinstance(v, SpatialResidual) and v.heading else -1
    p.axis, p.wanted = b.array(np.array(axes), dtype=int), wanted(v.target, len(axes), b)
    return p


def _position(keys: dict[str, Any], b: Binding) -> costs.SpatialParams:
    v = parse_keys(Position, keys, b)
    points = [point.scaled(1.0, v.lead) for point in place_points(v.of, "of", b)]
    points += [point.scaled(-1.0) for point in place_points(v.relative_to or (), "relative_to", b)]
    return _spatial(v, points, b)


def _between(v: Velocity | AngularVelocity, b: Binding) -> list[Point]:
    points = place_points(v.of, "of", b)
    return points + [point.scaled(-1.0) for point in place_points(v.relative_to or (), "relative_to", b)]


def _velocity(keys: dict[str, Any], b: Binding) -> costs.SpatialParams:
    v = parse_keys(Velocity, keys, b)
    return _spatial(v, _between(v, b), b)


def _angular_velocity(keys: dict[str, Any], b: Binding) -> costs.SpatialParams:
    v = parse_keys(AngularVelocity, keys, b)
    return _spatial(v, _between(v, b), b)


def _momentum(keys: dict[str, Any], b: Binding) -> costs.SpatialParams:
    v = parse_keys(Momentum, keys, b)
    bodies = massive(v.of, "of", b)
    com, mass = b.layout.body_com[bodies].tolist(), b.layout.body_mass[bodies].tolist()
    points = [Point(int(body), tuple(at), m) for body, at, m in zip(bodies, com, mass, strict=True)]
    return _spatial(v, points, b)


def _angular_momentum(keys: dict[str, Any], b: Binding) -> costs.AngularMomentumParams:
    v = parse_keys(Momentum, keys, b)
    bodies = massive(v.of, "of", b)
    p = costs.AngularMomentumParams()
    p.own = _spatial(v, place_points((CentreOfMass(centre_of_mass=v.of),), "of", b), b)
    p.mass = b.array(b.layout.body_mass[bodies], dtype=float)
    p.inertia = b.array(b.layout.body_inertia[bodies], dtype=wp.mat33)
    return p


def _rotation(keys: dict[str, Any], b: Binding) -> costs.RotationParams:
    v = parse_keys(RotationKeys, keys, b)
    p = costs.RotationParams()
    p.of, p.to, p.norm = b.frame(v.of, "of"), b.frame(v.to, "to"), v.norm.struct()
    p.axis = b.array(["xyz".index(axis) for axis in v.axes], dtype=int)
    return p


def _axes(p: costs.SpatialParams) -> int:
    return p.axis.shape[0]


TERMS = (
    CostTerm(
        "position_residual",
        costs.position_residual,
        costs.SpatialParams,
        _position,
        Position,
        residual=Residual(costs.position_component, _axes),
    ),
    CostTerm(
        "velocity_residual",
        costs.velocity_residual,
        costs.SpatialParams,
        _velocity,
        Velocity,
        residual=Residual(costs.velocity_component, _axes),
    ),
    CostTerm(
        "angular_velocity_residual",
        costs.angular_velocity_residual,
        costs.SpatialParams,
        _angular_velocity,
        AngularVelocity,
        residual=Residual(costs.angular_velocity_component, _axes),
    ),
    CostTerm(
        "rotation_residual",
        costs.rotation_residual,
        costs.RotationParams,
        _rotation,
        RotationKeys,
        residual=Residual(costs.rotation_component, lambda p: 3 * p.axis.shape[0]),
    ),
    CostTerm(
        "momentum_residual",
        costs.momentum_residual,
        costs.SpatialParams,
        _momentum,
        Momentum,
        residual=Residual(costs.velocity_component, _axes),
    ),
    CostTerm(
        "angular_momentum_residual",
        costs.angular_momentum_residual,
        costs.AngularMomentumParams,
        _angular_momentum,
        Momentum,
        residual=Residual(costs.angular_momentum_component, lambda p: p.own.axis.shape[0], norm=attrgetter("own.norm")),
    ),
)
"""Residual terms in space."""
