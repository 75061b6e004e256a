# SPDX-License-Identifier: Apache-2.0
"""Residuals that the general terms are norms of, for planners that take their derivatives."""

from __future__ import annotations

from typing import Any

from ..kernels.terms import components
from ..kernels.terms.norms import L22, QUADRATIC, Norm
from .term import Residual

ROUNDED = 0.01
"""Lengths and angles, which have a kink at zero, are rounded within a centimetre or a hundredth of a radian (the L2
norm of Howell et al. 2022) where derivatives are taken."""


def _norm(kind: int, p: float) -> Norm:
    norm = Norm()
    norm.kind, norm.p, norm.q = int(kind), p, 2.0
    return norm


def half_square(_params: Any = None) -> Norm:
    """½ Σ r²."""
    return _norm(QUADRATIC, 1.0)


def length(_params: Any = None) -> Norm:
    """√(Σ r² + p²) - p."""
    return _norm(L22, ROUNDED)


def _straight(p: Any) -> int:
    """The axes of a distance that is a straight line and does not saturate, else none."""
    straight = p.near == 0.0 and (not p.planar or p.field < 0)
    return (2 if p.planar else 3) if straight else 0


def _heading(p: Any) -> int:
    """One where a heading counts alike everywhere, else none."""
    return 0 if p.near > 0.0 else 1


DISTANCE = Residual(components.distance_component, _straight, norm=length)
YAW = Residual(components.yaw_component, _heading, norm=lambda p: _norm(L22, max(p.smooth, ROUNDED)))
CONTROL_EFFORT = Residual(components.control_component, lambda p: p.count, norm=half_square)
CONTROL_RATE = Residual(components.control_rate_component, lambda p: p.count, norm=half_square)
JOINT_LIMIT = Residual(components.joint_limit_component, lambda p: p.coord.shape[0], norm=half_square)
JOINT_VELOCITY = Residual(components.joint_velocity_component, lambda p: p.joint.shape[0], norm=half_square)
POSTURE = Residual(components.posture_component, lambda p: p.coord.shape[0], norm=half_square)
HEIGHT = Residual(components.height_component, lambda p: 1, norm=length)
ORIENTATION = Residual(components.orientation_component, lambda p: 3, norm=length)
