# SPDX-License-Identifier: Apache-2.0
"""Draws of physical properties: their range, their distribution, and what each one depends on."""

import numpy as np
import pytest
import scipy.stats
import warp as wp

from warpmpc.kernels.engine.randomize import DrawRules, Draws, count_kernel, draw_kernel

FIELDS = ("mass", "friction", "size")


def draw(width, *, draws: int, seed: int, ends: bool = False, plans: int = 1, redraw: bool = True, device: str):
    """Draw every property with widths [items] in some plans; returns that of the last: field → [N, items, ...]."""
    rules, out, shape = DrawRules(), Draws(), (draws, len(width))
    for name in FIELDS:
        setattr(rules, name, wp.array(width, dtype=float, device=device))
    rules.mass_ends = rules.friction_ends = wp.full(len(width), int(ends), dtype=int, device=device)
    rules.redraw, rules.seed = wp.full(len(width), int(redraw), dtype=int, device=device), seed
    out.mass, out.friction = (wp.empty(shape, dtype=wp.float64, device=device) for _ in range(2))
    out.size = wp.empty((*shape, 3), dtype=wp.float64, device=device)
    first = wp.zeros(1, dtype=int, device=device)
    for _ in range(plans):
        wp.launch(draw_kernel, dim=shape, inputs=[rules, first], outputs=[out], device=device)
        wp.launch(count_kernel, dim=1, inputs=[draws], outputs=[first], device=device)
    return {name: getattr(out, name).numpy() for name in FIELDS}


@pytest.mark.parametrize("field", ["mass", "friction"])
@pytest.mark.parametrize("seed", [0, 1, -7])
def test_scales_are_uniform_around_one(seed, field, device):
    spread = np.array([0.3, 0.05])
    scale = draw(spread, draws=4096, seed=seed, device=device)[field]
    for i, p in enumerate(spread):
        assert scipy.stats.kstest(scale[:, i], "uniform", args=(1.0 - p, 2.0 * p)).pvalue > 1e-3
    assert abs(np.corrcoef(scale.T)[0, 1]) < 5.0 / np.sqrt(4096)


@pytest.mark.parametrize("seed", [0, 1, -7])
def test_offsets_are_truncated_normals(seed, device):
    sigma = np.array([0.005, 0.9])
    offset = draw(sigma, draws=4096, seed=seed, device=device)["size"]
    assert np.all(np.abs(offset) <= 3.0 * sigma[None, :, None] * (1.0 + 1e-4))
    assert np.abs(offset / sigma[None, :, None]).max() > 2.7
    for i, s in enumerate(sigma):
        assert scipy.stats.kstest(offset[:, i].ravel(), "truncnorm", args=(-3.0, 3.0, 0.0, s)).pvalue > 1e-3
    correlation = np.corrcoef(offset.reshape(4096, 6).T)
    np.testing.assert_allclose(correlation, np.eye(6), atol=5.0 / np.sqrt(4096))


def test_mass_and_friction_may_be_off_by_all_of_it(device):
    inner, ends = (draw([0.2, 0.3], draws=64, seed=4, ends=e, device=device) for e in (False, True))
    for field in ("mass", "friction"):
        np.testing.assert_allclose(np.abs(ends[field] - 1.0), np.tile(np.float32([0.2, 0.3]), (64, 1)))
        np.testing.assert_array_equal(ends[field] > 1.0, inner[field] > 1.0)
    np.testing.assert_array_equal(ends["size"], inner["size"])


def test_more_draws_and_more_items_leave_the_first_as_they_were(device):
    few = draw([0.1, 0.2], draws=5, seed=9, device=device)
    many = draw([0.1, 0.2, 0.4], draws=50, seed=9, device=device)
    for field in FIELDS:
        np.testing.assert_array_equal(many[field][:5, :2], few[field])


def test_plans_go_on_counting_draws_where_they_are_drawn_anew(device):
    all_at_once = draw([0.1, 0.2], draws=12, seed=9, device=device)
    for plans in (1, 2, 3):
        found = draw([0.1, 0.2], draws=4, seed=9, plans=plans, device=device)
        again = draw([0.1, 0.2], draws=4, seed=9, plans=plans, redraw=False, device=device)
        for field in FIELDS:
            np.testing.assert_array_equal(found[field], all_at_once[field][4 * (plans - 1) : 4 * plans])
            np.testing.assert_array_equal(again[field], all_at_once[field][:4])


def test_draws_differ_between_rows_items_seeds_and_properties(device):
    a, b = (draw([0.1] * 8, draws=64, seed=seed, device=device) for seed in (0, 30))
    values = np.concatenate([found[field].ravel() for found in (a, b) for field in FIELDS])
    assert len(np.unique(values)) > 0.99 * len(values)
    for first, second in ((a["mass"], b["mass"]), (a["mass"], a["friction"]), (a["mass"], a["size"][:, :, 0])):
        assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 5.0 / np.sqrt(first.size)


def test_no_width_is_no_randomization(device):
    found = draw([0.0], draws=4, seed=1, device=device)
    assert np.all(found["mass"] == 1.0)
    assert np.all(found["friction"] == 1.0)
    assert np.all(found["size"] == 0.0)
