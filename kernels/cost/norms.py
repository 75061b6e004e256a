# SPDX-License-Identifier: Apache-2.0
"""Norms of residuals (Howell et al. 2022, MuJoCo MPC): value, gradient and Hessian in closed form.

Every norm is a function of Σ f(x_i): ``norm_part`` is f, ``norm_total`` the function around the sum, so that a residual
of any dimension is taken number by number. Gradient and Hessian are asked for entry by entry, too.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

QUADRATIC = wp.constant(0)
L22 = wp.constant(1)
COSH = wp.constant(2)
POWER = wp.constant(3)
SMOOTH_ABS2 = wp.constant(4)
RECTIFY = wp.constant(5)
SQUARES = wp.constant(6)

LEAST = wp.constant(1.0e-6)
"""Nearer to zero than this (a fraction of p but for powers, whose p is the exponent), second derivatives are those at
it: exponents below 2 have no bound."""


@wp.struct
class Norm:
    """A norm and its parameters."""

    kind: int
    p: float
    q: float  # of L22 and SMOOTH_ABS2, whose q = 2 is L2 and SmoothAbs


@wp.func
def rounded(x: float, p: float, q: float) -> float:
    """(|x|^q + p^q)^{1/q} - p, for x that is not negative."""
    if q == 2.0:
        return x * x / (wp.sqrt(x * x + p * p) + p)  # nothing cancels
    most = wp.max(x, p)
    return most * wp.pow(1.0 + wp.pow(wp.min(x, p) / most, q), 1.0 / q) - p


@wp.func
def rounded_slope(x: float, p: float, q: float) -> float:
    """Its derivative."""
    u = x / p
    if u > 1.0:
        return wp.pow(1.0 + wp.pow(1.0 / u, q), 1.0 / q - 1.0)
    return wp.pow(u, q - 1.0) * wp.pow(1.0 + wp.pow(u, q), 1.0 / q - 1.0)


@wp.func
def rounded_bend(x: float, p: float, q: float) -> float:
    """Its second derivative."""
    u = wp.max(x / p, LEAST)
    if u > 1.0:
        t = 1.0 / u
        return (q - 1.0) / p * wp.pow(t, q + 1.0) * wp.pow(1.0 + wp.pow(t, q), 1.0 / q - 2.0)
    return (q - 1.0) / p * wp.pow(u, q - 2.0) * wp.pow(1.0 + wp.pow(u, q), 1.0 / q - 2.0)


@wp.func
def norm_part(x: float, norm: Norm) -> float:
    """Contribution of one number of a residual to the sum that a norm is a function of."""
    kind = norm.kind
    p = norm.p
    if kind == COSH:
        root = wp.sinh(0.5 * x / p)
        return 2.0 * p * p * root * root  # cosh(x) - 1 without its cancellation
    if kind == POWER:
        return wp.pow(wp.abs(x), p)
    if kind == SMOOTH_ABS2:
        return rounded(wp.abs(x), p, norm.q)
    if kind == RECTIFY:
        return wp.max(x, 0.0) + p * wp.log(1.0 + wp.exp(-wp.abs(x) / p))
    return x * x


@wp.func
def norm_total(sum: float, norm: Norm) -> float:
    """The norm, from the sum of its parts."""
    if norm.kind == QUADRATIC:
        return 0.5 * sum
    if norm.kind == L22:
        return rounded(wp.sqrt(sum), norm.p, norm.q)
    return sum


@wp.func
def norm_slope(x: float, sum: float, norm: Norm) -> float:
    """Entry i of the gradient, ∂n/∂x_i.

    Args:
        x: Number i of the residual.
        sum: Sum of the parts of all of them.
        norm: The norm.
    """
    kind = norm.kind
    p = norm.p
    size = wp.abs(x)
    if kind == L22:
        length = wp.max(wp.sqrt(sum), LEAST * p)
        return rounded_slope(length, p, norm.q) / length * x
    if kind == COSH:
        return p * wp.sinh(x / p)
    if kind == POWER:
        return wp.sign(x) * p * wp.pow(size, p - 1.0) * wp.where(x == 0.0, 0.0, 1.0)
    if kind == SMOOTH_ABS2:
        return wp.sign(x) * rounded_slope(size, p, norm.q) * wp.where(x == 0.0, 0.0, 1.0)
    if kind == RECTIFY:
        small = wp.exp(-size / p)
        return wp.where(x > 0.0, 1.0, small) / (1.0 + small)
    return wp.where(kind == SQUARES, 2.0 * x, x)


@wp.func
def norm_bend(x: float, y: float, same: int, sum: float, norm: Norm) -> float:
    """Entry ij of the Hessian, ∂²n/∂x_i∂x_j.

    Args:
        x: Number i of the residual.
        y: Number j.
        same: Whether i is j.
        sum: Sum of the parts of all of them.
        norm: The norm.
    """
    kind = norm.kind
    p = norm.p
    if kind == L22:
        length = wp.max(wp.sqrt(sum), LEAST * p)
        slope = rounded_slope(length, p, norm.q) / length
        along = (rounded_bend(length, p, norm.q) - slope) * (x / length) * (y / length)
        return along + wp.where(same != 0, slope, 0.0)
    if same == 0:
        return 0.0
    if kind == COSH:
        return wp.cosh(x / p)
    if kind == POWER:
        return p * (p - 1.0) * wp.pow(wp.max(wp.abs(x), LEAST), p - 2.0)
    if kind == SMOOTH_ABS2:
        return rounded_bend(wp.abs(x), p, norm.q)
    if kind == RECTIFY:
        small = wp.exp(-wp.abs(x) / p)
        return small / ((1.0 + small) * (1.0 + small) * p)
    return wp.where(kind == SQUARES, 2.0, 1.0)
