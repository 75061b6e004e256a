# SPDX-License-Identifier: Apache-2.0
"""Norms of residuals: value, gradient and Hessian against float64, and what scene files may say about them."""

import numpy as np
import pytest
import warp as wp
from pydantic import ValidationError

from warpmpc.cost.norms import NormKeys
from warpmpc.cost.residual import fixed_norm
from warpmpc.kernels.cost.norms import SQUARES, Norm, norm_bend, norm_part, norm_slope, norm_total

VALUE = {
    "quadratic": lambda x, p, q: 0.5 * (x * x).sum(),
    "squares": lambda x, p, q: (x * x).sum(),
    "l22": lambda x, p, q: (np.linalg.norm(x) ** q + p**q) ** (1.0 / q) - p,
    "l2": lambda x, p, q: np.sqrt((x * x).sum() + p * p) - p,
    "cosh": lambda x, p, q: (p * p * (np.cosh(x / p) - 1.0)).sum(),
    "power": lambda x, p, q: (np.abs(x) ** p).sum(),
    "smooth_abs": lambda x, p, q: (np.sqrt(x * x + p * p) - p).sum(),
    "smooth_abs2": lambda x, p, q: ((np.abs(x) ** q + p**q) ** (1.0 / q) - p).sum(),
    "rectify": lambda x, p, q: (p * np.log1p(np.exp(x / p))).sum(),
}
"""The norms as they are defined."""
NORMS = [
    {"kind": "quadratic"},
    {"kind": "squares"},  # of terms that sum squares, without a key
    {"kind": "l22", "p": 0.3, "q": 3.0},
    {"kind": "l22", "p": 0.02, "q": 2.0},
    {"kind": "l22", "p": 0.5, "q": 1.4},
    {"kind": "l2", "p": 0.1},
    {"kind": "cosh", "p": 0.3},
    {"kind": "power", "p": 2.0},
    {"kind": "power", "p": 3.5},
    {"kind": "smooth_abs", "p": 0.1},
    {"kind": "smooth_abs2", "p": 0.2, "q": 4.0},
    {"kind": "smooth_abs2", "p": 0.4, "q": 1.5},
    {"kind": "rectify", "p": 0.1},
]
NAMES = ["-".join(map(str, norm.values())) for norm in NORMS]


@wp.kernel
def derivatives_kernel(
    # inputs
    x: wp.array[float],  # [n]
    norm: Norm,
    # outputs
    value: wp.array[float],  # [1]
    slope: wp.array[float],  # [n]
    bend: wp.array2d[float],  # [n, n]
):
    """One thread: a norm with its gradient and its Hessian."""
    total = wp.float32(0.0)
    for i in range(x.shape[0]):
        total += norm_part(x[i], norm)
    value[0] = norm_total(total, norm)
    for i in range(x.shape[0]):
        slope[i] = norm_slope(x[i], total, norm)
        for j in range(x.shape[0]):
            bend[i, j] = norm_bend(x[i], x[j], int(i == j), total, norm)


def derivatives(x: np.ndarray, norm: dict, device: str) -> tuple[float, np.ndarray, np.ndarray]:
    """Value, gradient ``[n]`` and Hessian ``[n, n]`` by the kernels' functions."""
    n = len(x)
    out = [wp.zeros(shape, dtype=float, device=device) for shape in (1, n, (n, n))]
    residual = wp.array(x, dtype=float, device=device)
    given = fixed_norm(SQUARES) if norm["kind"] == "squares" else NormKeys.model_validate(norm).struct()
    wp.launch(derivatives_kernel, 1, [residual, given], out, device=device)
    value, slope, bend = (array.numpy() for array in out)
    return float(value[0]), slope, bend


def exact(x: np.ndarray, norm: dict, step: float = 1e-5) -> tuple[float, np.ndarray, np.ndarray]:
    """The same in float64: gradient and Hessian by central differences, in two step sizes."""

    def f(x: np.ndarray) -> float:
        return VALUE[norm["kind"]](x, norm.get("p"), norm.get("q"))

    eye = np.eye(len(x))
    slope = np.array([f(x + step * e) - f(x - step * e) for e in eye]) / (2.0 * step)
    h = 20.0 * step
    bend = [
        [f(x + h * (a + b)) - f(x + h * (a - b)) - f(x - h * (a - b)) + f(x - h * (a + b)) for b in eye] for a in eye
    ]
    return f(x), slope, np.array(bend) / (4.0 * h * h)


@pytest.mark.parametrize("norm", NORMS, ids=NAMES)
@pytest.mark.parametrize("scale", [0.05, 1.0, 4.0])
def test_norms_and_their_derivatives_are_those_of_their_definition(norm, scale, device):
    rng = np.random.default_rng(int(10 * scale))
    for n in (1, 3, 5):
        x = np.float64(np.float32(scale * rng.uniform(0.2, 1.0, n) * rng.choice([-1.0, 1.0], n)))
        found, expected = derivatives(x, norm, device), exact(x, norm)
        assert found[0] == pytest.approx(expected[0], rel=1e-5, abs=1e-7)
        np.testing.assert_allclose(found[1], expected[1], rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(found[2], expected[2], rtol=1e-3, atol=1e-4 * np.abs(expected[2]).max() + 1e-7)


@pytest.mark.parametrize("norm", NORMS, ids=NAMES)
def test_at_zero_and_far_away_everything_is_finite(norm, device):
    for x in ([0.0, 0.0, 0.0], [0.0, 1e-9, -3.0], [20.0, -20.0, 0.0]):
        value, slope, bend = derivatives(np.array(x), norm, device)
        assert np.isfinite(value)
        assert np.isfinite(slope).all()
        assert np.isfinite(bend).all()
    value, slope, _ = derivatives(np.zeros(3), norm, device)
    if norm["kind"] == "rectify":
        assert value == pytest.approx(3 * norm["p"] * np.log(2.0))
    else:
        assert value == pytest.approx(0.0, abs=1e-7)
        np.testing.assert_array_equal(slope, 0.0)


@pytest.mark.parametrize(
    ("norm", "message"),
    [
        ({"kind": "quadratic", "p": 1.0}, "takes neither p nor q"),
        ({"kind": "smooth_abs"}, "takes p"),
        ({"kind": "l22", "p": 1.0}, "takes p and q"),
        ({"kind": "l2", "p": 1.0, "q": 2.0}, "takes p"),
        ({"kind": "power", "p": 0.5}, "1 or more"),
        ({"kind": "cosh", "p": 0.0}, "greater than 0"),
        ({"kind": "smooth"}, "smooth_abs"),
    ],
)
def test_a_norm_takes_its_own_parameters(norm, message):
    with pytest.raises(ValidationError, match=message):
        NormKeys.model_validate(norm)
