# SPDX-License-Identifier: Apache-2.0
"""Work left to push an object, sampled: fractional sides of directions, values between and beyond cells and sides."""

import numpy as np
import pytest
import warp as wp
from field_samples import CELL, ORIGIN, sampled
from scipy.interpolate import RegularGridInterpolator

from warpmpc.cost.resources.push_value import ANGLES
from warpmpc.kernels.geometry.fields import sample_push, side_of


@wp.kernel
def side_kernel(
    # inputs
    angle: wp.array[float],
    # outputs
    side: wp.array[float],
):
    """The side of one direction."""
    i = wp.tid()
    side[i] = side_of(angle[i])


@wp.kernel
def sample_push_kernel(
    # inputs
    value: wp.array4d[float],
    origin: wp.vec2,
    cell: float,
    at: wp.array[wp.vec2],
    angle: wp.array[float],
    # outputs
    out: wp.array2d[float],
):
    """Sample one environment's value at one point and direction."""
    e, i = wp.tid()
    out[e, i] = sample_push(value, e, origin, cell, at[i], angle[i])


def side_at(angle, device: str) -> np.ndarray:
    """Fractional sides of directions [n]."""
    out = wp.zeros(len(angle), dtype=float, device=device)
    wp.launch(
        side_kernel,
        dim=len(angle),
        inputs=[wp.array(angle, dtype=float, device=device)],
        outputs=[out],
        device=device,
    )
    return out.numpy().astype(np.float64)


def sample(value: np.ndarray, at, angle, device: str) -> np.ndarray:
    """Samples [E, n] of values [E, 16, rows, columns] at points [n, 2] and directions [n]."""
    (found,) = sampled(sample_push_kernel, np.moveaxis(value, 1, -1), at, angle, device=device)
    return found


@pytest.mark.parametrize("turns", [-2, -1, 0, 1, 3])
def test_the_16_directions_have_whole_sides_and_those_between_go_on_evenly(turns, device):
    full = 2.0 * np.pi * turns
    error = side_at(ANGLES + full, device) - np.arange(16)
    np.testing.assert_allclose((error + 8.0) % 16.0 - 8.0, 0.0, atol=3e-5)
    angle = np.linspace(0.01, 2.0 * np.pi - 0.01, 1000)
    found = side_at(angle + full, device)
    assert (np.diff(found) > 0.0).all()
    assert np.diff(found).max() < 0.03
    np.testing.assert_allclose(found, np.interp(angle, [*ANGLES, 2.0 * np.pi], np.arange(17)), atol=1e-4)
    seam = side_at(np.array([-1e-3, 1e-3]) + full, device)
    np.testing.assert_allclose(seam, [16.0 - 1e-3 / ANGLES[1], 1e-3 / ANGLES[1]], atol=1e-4)


def test_at_cells_and_sides_a_sample_is_the_table(device):
    value = np.random.default_rng(0).normal(size=(2, 16, 4, 6))
    index = np.array(list(np.ndindex(16, 4, 6)))
    at = np.array(ORIGIN) + CELL * index[:, [2, 1]]
    found = sample(value, at, ANGLES[index[:, 0]], device)
    np.testing.assert_allclose(found, value.reshape(2, -1), atol=2e-5)


@pytest.mark.parametrize("seed", range(2))
def test_between_cells_and_sides_a_sample_is_linear_and_grows_outside_the_grid(seed, device):
    rng = np.random.default_rng(seed)
    value = rng.normal(size=(2, 16, 4, 6))
    low, high = np.array(ORIGIN), np.array(ORIGIN) + CELL * np.array([5, 3])
    at = rng.uniform(low - 1.0, high + 1.0, size=(300, 2))
    angle = rng.uniform(-7.0, 7.0, size=300)
    inside = np.clip(at, low, high)
    outside = np.linalg.norm(at - inside, axis=1)
    assert 30 < (outside == 0.0).sum() < 270
    sides = np.interp(angle % (2.0 * np.pi), [*ANGLES, 2.0 * np.pi], np.arange(17))
    cells = (inside - low) / CELL
    found = sample(value, at, angle, device)
    for e in range(2):
        axes = np.arange(17), np.arange(4), np.arange(6)
        table = RegularGridInterpolator(axes, np.concatenate([value[e], value[e, :1]]))
        expected = table(np.stack([sides, cells[:, 1], cells[:, 0]], axis=1)) + outside
        np.testing.assert_allclose(found[e], expected, atol=5e-5)
