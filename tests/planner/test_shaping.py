# SPDX-License-Identifier: Apache-2.0
"""Shaping matrices against SciPy and the recursions they stand for."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from warpmpc.kernels.planner import splines as kernels
from warpmpc.planner.noise import bspline, coloured, comb, identity
from warpmpc.planner.splines import SplineKind, spline_table

COUNTS = pytest.mark.parametrize("count", [1, 2, 3, 8, 30])
SHAPES = pytest.mark.parametrize(
    "shape",
    [identity, bspline, comb, lambda n: coloured(n, 1.0), lambda n: coloured(n, 2.5)],
    ids=["identity", "bspline", "comb", "pink", "steep"],
)


@COUNTS
@SHAPES
def test_every_knot_has_noise_of_unit_deviation(shape, count):
    matrix = shape(count)
    assert matrix.shape == (count, count)
    assert matrix.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(matrix, axis=1), 1.0, rtol=1e-6)


def test_bspline_passes_smoothly_through_its_noise_knots():
    z = np.random.default_rng(0).normal(size=30)
    curve = bspline(30, 6, normalize=False) @ z
    expected = CubicSpline(np.linspace(0, 29, 6), z[:6])(np.arange(30))  # not-a-knot ends
    np.testing.assert_allclose(curve, expected, atol=1e-5)


@pytest.mark.parametrize(("count", "noise_knots"), [(12, None), (12, 1), (12, 2), (12, 3), (5, 5), (1, None)])
def test_bspline_uses_as_many_columns_as_noise_knots(count, noise_knots):
    matrix = bspline(count, noise_knots)
    rank = noise_knots or max(count // 2, 1)
    assert np.linalg.matrix_rank(matrix) == rank
    assert not np.any(matrix[:, rank:])


def test_bspline_with_a_noise_knot_per_knot_is_white():
    np.testing.assert_allclose(bspline(9, 9), identity(9), atol=1e-6)


@pytest.mark.parametrize("noise_knots", [0, 13])
def test_bspline_refuses_a_count_of_noise_knots_it_cannot_place(noise_knots):
    with pytest.raises(ValueError, match="noise_knots"):
        bspline(12, noise_knots)


def test_smooth_shapes_change_less_from_knot_to_knot():
    def roughness(matrix: np.ndarray) -> float:
        return float(np.mean(np.sum(np.diff(matrix, axis=0) ** 2, axis=1)))

    white = roughness(identity(30))
    for matrix in (bspline(30), comb(30), coloured(30, 1.0)):
        assert roughness(matrix) < 0.6 * white
    assert roughness(coloured(30, 2.0)) < 0.5 * roughness(coloured(30, 1.0))


@pytest.mark.parametrize("coefficients", [(0.3, 0.3, 0.4), (1.0, 0.5, -0.2)])
def test_comb_is_its_recursion(coefficients):
    c1, c2, c3 = coefficients
    z = np.random.default_rng(1).normal(size=20)
    u = np.zeros(22)
    for h in range(20):
        u[h + 2] = c1 * z[h] + c2 * u[h + 1] + c3 * u[h]
    np.testing.assert_allclose(comb(20, c1, c2, c3, normalize=False) @ z, u[2:], atol=1e-5)


def test_a_comb_that_lets_no_noise_through_is_refused():
    with pytest.raises(ValueError, match="without noise"):
        comb(5, 0.0)


def test_coloured_noise_of_exponent_zero_is_white():
    np.testing.assert_allclose(coloured(16, 0.0), identity(16), atol=1e-6)


@pytest.mark.parametrize("exponent", [0.5, 1.0, 2.0])
def test_coloured_noise_has_the_spectrum_of_its_exponent(exponent):
    matrix = coloured(512, exponent).astype(np.float64)
    window = np.hanning(512)[:, None]
    # the expected periodogram of B z, z white: the power of every column, summed
    power = np.sum(np.abs(np.fft.rfft(window * matrix, axis=0)) ** 2, axis=1)[8:200]
    slope = np.polyfit(np.log(np.arange(8, 200)), np.log(power), 1)[0]
    assert slope == pytest.approx(-exponent, abs=0.1)


def test_coloured_noise_is_stationary_and_does_not_tie_the_ends_together():
    matrix = coloured(40, 1.0).astype(np.float64)
    covariance = matrix @ matrix.T
    for lag in range(40):
        np.testing.assert_allclose(np.diag(covariance, lag), covariance[0, lag], atol=1e-5)
    assert covariance[0, 39] < 0.5 * covariance[0, 1]


def test_spline_kinds_map_to_the_kernels():
    codes = {kind.value: spline_table(kind, np.arange(3.0), 1.0, "cpu").kind for kind in SplineKind}
    assert codes == {
        "zero": kernels.ZERO,
        "linear": kernels.LINEAR,
        "cubic": kernels.CUBIC,
        "bspline": kernels.BSPLINE,
    }
    assert len(set(codes.values())) == 4
