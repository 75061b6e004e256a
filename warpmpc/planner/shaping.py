# SPDX-License-Identifier: Apache-2.0
"""Shaping matrices B ``[P, P]``: noise ε = σ ⊙ (B z) that is correlated over the knots of a plan.

With ``normalize`` the rows have unit length, so that every knot's noise has standard deviation σ whatever the shape.
Matrices are float32 arrays, ready to be copied to the device.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import make_interp_spline

from ..scene.schema import NoiseShape

if TYPE_CHECKING:
    from ..scene.schema import Noise


def shaping_matrix(noise: Noise, knots: int) -> np.ndarray:
    """The shaping matrix B ``[P, P]`` a scene asks for."""
    match noise.shape:
        case NoiseShape.IDENTITY:
            return identity(knots)
        case NoiseShape.BSPLINE:
            return bspline(knots, noise.knots)
        case NoiseShape.COMB:
            return comb(knots, *noise.comb)
        case NoiseShape.COLOURED:
            return coloured(knots, noise.exponent)


def schedule(noise: Noise, knots: int, iterations: int) -> np.ndarray:
    """Factor on σ in every iteration at every knot ``[n, P]``.

    With ``anneal = [β1, β2]`` it is exp(-i/(β1 N) - (H-h)/(β2 H)): later iterations and nearer knots are searched more
    finely (DIAL-MPC, Xue et al. 2024); else it is one.
    """
    if noise.anneal is None:
        return np.ones((iterations, knots), dtype=np.float32)
    first, second = noise.anneal
    i, h = np.arange(iterations)[:, None] / iterations, np.arange(1, knots + 1)[None] / knots
    return np.exp(-i / first - (1.0 - h) / second).astype(np.float32)


def identity(knots: int) -> np.ndarray:
    """White noise, every knot on its own."""
    return np.eye(knots, dtype=np.float32)


def bspline(knots: int, noise_knots: int | None = None, *, normalize: bool = True) -> np.ndarray:
    """Smooth noise: the cubic B-spline through few noise knots, evaluated at all knots (Pezzato et al. 2025).

    The noise knots are spread evenly from the first knot to the last. Only the first ``noise_knots`` rows of z are
    used; the other columns of B are zero.

    Args:
        noise_knots: Number of noise knots n, half of P if None (Pezzato et al. 2025; Bhardwaj et al.
            2021 take a quarter); fewer than four lower the degree to n - 1.
        normalize: Scale the rows to unit length.

    Returns:
        Matrix ``[P, P]`` of rank n.
    """
    count = max(knots // 2, 1) if noise_knots is None else noise_knots
    if not 1 <= count <= knots:
        raise ValueError(f"noise_knots must be between 1 and {knots}, got {count}")
    matrix = np.zeros((knots, knots))
    if count == 1:
        matrix[:, 0] = 1.0
    else:
        spline = make_interp_spline(np.arange(count), np.eye(count), k=min(3, count - 1))
        matrix[:, :count] = spline(np.linspace(0.0, count - 1.0, knots))
    return _finish(matrix, normalize)


def comb(knots: int, c1: float = 0.3, c2: float = 0.3, c3: float = 0.4, *, normalize: bool = True) -> np.ndarray:
    """Filtered noise u_h = c1 z_h + c2 u_{h-1} + c3 u_{h-2}, zero before the first knot (Bhardwaj et al. 2021).

    Returns:
        Lower-triangular matrix ``[P, P]``.
    """
    response = np.zeros(knots)
    for h in range(knots):
        response[h] = c1 if h == 0 else c2 * response[h - 1] + (c3 * response[h - 2] if h > 1 else 0.0)
    lag = np.subtract.outer(np.arange(knots), np.arange(knots))
    return _finish(np.where(lag >= 0, response[np.abs(lag)], 0.0), normalize)


def coloured(knots: int, exponent: float, *, normalize: bool = True) -> np.ndarray:
    """Coloured noise of power spectrum 1/f^α: 0 is white, 1 pink, 2 brown (iCEM, Pinneri et al. 2020).

    The covariance is that of a periodic process twice as long as the plan, its spectrum flat below its lowest
    frequency, so the first and the last knot are not tied together. B is the Cholesky factor of that covariance.

    Returns:
        Lower-triangular matrix ``[P, P]``.
    """
    frequency = np.maximum(np.abs(np.fft.fftfreq(2 * knots)), 1.0 / (2 * knots))
    covariance = np.fft.ifft(frequency**-exponent).real
    covariance /= covariance[0] if normalize else 1.0
    lag = np.abs(np.subtract.outer(np.arange(knots), np.arange(knots)))
    return _finish(np.linalg.cholesky(covariance[lag]), normalize)


def _finish(matrix: np.ndarray, normalize: bool) -> np.ndarray:
    """Scale the rows to unit length if asked to, and round to float32."""
    if normalize:
        length = np.linalg.norm(matrix, axis=1, keepdims=True)
        if np.any(length <= 0.0):
            raise ValueError("a knot without noise cannot be normalized")
        matrix = matrix / length
    return matrix.astype(np.float32)
