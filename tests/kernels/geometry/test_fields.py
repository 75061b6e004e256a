# SPDX-License-Identifier: Apache-2.0
"""Fields over the ground plane: bilinear values and gradients, on and beyond the grid."""

import numpy as np
import pytest
import warp as wp
from field_samples import CELL, ORIGIN, sampled
from scipy.interpolate import RegularGridInterpolator

from warpmpc.kernels.geometry.fields import field_gradient, sample_field

SHAPE = (6, 9)  # rows along y, columns along x


@wp.kernel
def sample_kernel(
    # inputs
    field: wp.array3d[float],
    origin: wp.vec2,
    cell: float,
    point: wp.array[wp.vec2],
    # outputs
    value: wp.array2d[float],
    gradient: wp.array2d[wp.vec2],
):
    """Sample one field at one point."""
    f, i = wp.tid()
    value[f, i] = sample_field(field, f, origin, cell, point[i])
    gradient[f, i] = field_gradient(field, f, origin, cell, point[i])


def sample(field: np.ndarray, points: np.ndarray, device: str) -> tuple[np.ndarray, np.ndarray]:
    """Values [F, n] and gradients [F, n, 2] of fields [F, rows, columns] at points [n, 2]."""
    value, gradient = sampled(sample_kernel, field, points, outputs=(float, wp.vec2), device=device)
    return value, gradient


def axes() -> tuple[np.ndarray, np.ndarray]:
    """Coordinates of rows and columns [m]."""
    return ORIGIN[1] + CELL * np.arange(SHAPE[0]), ORIGIN[0] + CELL * np.arange(SHAPE[1])


@pytest.mark.parametrize("seed", range(3))
def test_values_are_bilinear_and_clamped_to_the_border(seed, device):
    rng = np.random.default_rng(seed)
    field = rng.normal(size=(2, *SHAPE))
    y, x = axes()
    points = rng.uniform([x[0] - 1.0, y[0] - 1.0], [x[-1] + 1.0, y[-1] + 1.0], size=(200, 2))
    corners = [(x[0], y[0]), (x[-1], y[-1]), (x[0], y[-1]), (x[3], y[2])]
    points = np.concatenate([points, corners])
    value, _ = sample(field, points, device)
    inside = np.clip(points, [x[0], y[0]], [x[-1], y[-1]])
    for f in range(2):
        expected = RegularGridInterpolator((y, x), field[f])(inside[:, ::-1])
        np.testing.assert_allclose(value[f], expected, atol=2e-5)


def test_gradients_are_central_differences(device):
    y, x = axes()
    field = np.stack([2.0 * x[None, :] - 3.0 * y[:, None], x[None, :] * y[:, None]])
    inner = np.random.default_rng(1).uniform([x[1], y[1]], [x[-2], y[-2]], size=(50, 2))
    _, gradient = sample(field, inner, device)
    np.testing.assert_allclose(gradient[0], np.tile([2.0, -3.0], (50, 1)), atol=1e-4)
    # exact for a bilinear field, and not to be confused in its axes
    np.testing.assert_allclose(gradient[1], inner[:, ::-1], atol=1e-4)
