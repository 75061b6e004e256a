# SPDX-License-Identifier: Apache-2.0
"""Draws of physical properties: their range, their distribution, and what each one depends on."""

import numpy as np
import pytest
import scipy.stats
import warp as wp

from warpmpc.kernels.worlds.randomize import normal_offset_kernel, uniform_scale_kernel


def draw(kernel, width, *, draws: int, seed: int, first_item: int = 0, nominal_first: bool = False, device: str):
    """Run a kernel on widths [items]; returns scales [N, items] or offsets [N, items, 3]."""
    tail = () if kernel is uniform_scale_kernel else (3,)
    out = wp.empty((draws, len(width), *tail), dtype=float, device=device)
    wp.launch(
        kernel,
        dim=(draws, len(width)),
        inputs=[wp.array(width, dtype=float, device=device), seed, first_item, int(nominal_first)],
        outputs=[out],
        device=device,
    )
    return out.numpy().astype(np.float64)


KERNELS = pytest.mark.parametrize("kernel", [uniform_scale_kernel, normal_offset_kernel])


@pytest.mark.parametrize("seed", [0, 1, -7])
def test_scales_are_uniform_around_one(seed, device):
    spread = np.array([0.3, 0.05])
    scale = draw(uniform_scale_kernel, spread, draws=4096, seed=seed, device=device)
    for i, p in enumerate(spread):
        assert scipy.stats.kstest(scale[:, i], "uniform", args=(1.0 - p, 2.0 * p)).pvalue > 1e-3
    assert abs(np.corrcoef(scale.T)[0, 1]) < 5.0 / np.sqrt(4096)


@pytest.mark.parametrize("seed", [0, 1, -7])
def test_offsets_are_truncated_normals(seed, device):
    sigma = np.array([0.005, 2.0])
    offset = draw(normal_offset_kernel, sigma, draws=4096, seed=seed, device=device)
    assert np.all(np.abs(offset) <= 3.0 * sigma[None, :, None] * (1.0 + 1e-4))
    assert np.abs(offset / sigma[None, :, None]).max() > 2.7
    for i, s in enumerate(sigma):
        assert scipy.stats.kstest(offset[:, i].ravel(), "truncnorm", args=(-3.0, 3.0, 0.0, s)).pvalue > 1e-3
    correlation = np.corrcoef(offset.reshape(4096, 6).T)
    np.testing.assert_allclose(correlation, np.eye(6), atol=5.0 / np.sqrt(4096))


@pytest.mark.parametrize(("kernel", "nominal"), [(uniform_scale_kernel, 1.0), (normal_offset_kernel, 0.0)])
def test_the_first_draw_can_be_nominal_and_the_others_do_not_care(kernel, nominal, device):
    plain = draw(kernel, [0.2, 0.3], draws=8, seed=4, device=device)
    with_nominal = draw(kernel, [0.2, 0.3], draws=8, seed=4, nominal_first=True, device=device)
    assert np.all(with_nominal[0] == nominal)
    assert np.all(plain[0] != nominal)
    np.testing.assert_array_equal(with_nominal[1:], plain[1:])


@KERNELS
def test_more_draws_and_more_items_leave_the_first_as_they_were(kernel, device):
    few = draw(kernel, [0.1, 0.2], draws=5, seed=9, device=device)
    many = draw(kernel, [0.1, 0.2, 0.4], draws=50, seed=9, device=device)
    np.testing.assert_array_equal(many[:5, :2], few)


@KERNELS
def test_first_item_names_the_column_a_draw_belongs_to(kernel, device):
    whole = draw(kernel, [0.1, 0.1, 0.1], draws=6, seed=2, device=device)
    rest = draw(kernel, [0.1, 0.1], draws=6, seed=2, first_item=1, device=device)
    np.testing.assert_array_equal(rest, whole[:, 1:])


@KERNELS
def test_draws_differ_between_rows_items_and_seeds(kernel, device):
    a, b = (draw(kernel, [0.1] * 8, draws=64, seed=seed, device=device) for seed in (0, 1))
    values = np.concatenate([a.ravel(), b.ravel()])
    assert len(np.unique(values)) > 0.99 * len(values)
    assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 5.0 / np.sqrt(a.size)


@KERNELS
def test_no_width_is_no_randomization(kernel, device):
    np.testing.assert_array_equal(
        draw(kernel, [0.0], draws=4, seed=1, device=device), float(kernel is uniform_scale_kernel)
    )
