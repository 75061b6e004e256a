# SPDX-License-Identifier: Apache-2.0
"""Splines against SciPy, what each kind promises, and plans re-sampled later."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import BSpline, CubicHermiteSpline

from warpmpc.kernels.planner.splines import (
    BSPLINE,
    CUBIC,
    LINEAR,
    ZERO,
    Spline,
    advance_plan_kernel,
    command_kernel,
    shift_knots_kernel,
    spline_control_kernel,
)
from warpmpc.planner.splines import SplineKind, spline_table

KINDS = [ZERO, LINEAR, CUBIC, BSPLINE]


def reference_spline(knots: np.ndarray, kind: int, tau: np.ndarray) -> np.ndarray:
    """Spline over knots [P, ...] at times τ [T] in knot intervals, in float64; returns [T, ...]."""
    grid = np.arange(len(knots))
    tau = np.clip(tau, 0.0, len(knots) - 1)
    if len(knots) == 1:
        return np.repeat(knots, len(tau), axis=0)
    if kind == ZERO:
        return knots[np.searchsorted(grid, tau + 1e-9, side="right") - 1]
    if kind == LINEAR:
        i = np.minimum(tau.astype(int), len(knots) - 2)
        x = (tau - i).reshape(-1, *[1] * (knots.ndim - 1))
        return knots[i] + x * (knots[i + 1] - knots[i])
    if kind == CUBIC:
        return CubicHermiteSpline(grid, knots, np.gradient(knots, axis=0))(tau)
    polygon = np.concatenate([2 * knots[:1] - knots[1:2], knots, 2 * knots[-1:] - knots[-2:-1]])
    return BSpline(np.arange(-3, len(knots) + 3), polygon, 3)(tau)


def table(kind: int, count: int, *, knot_dt: float = 1.0, times=None, device: str) -> Spline:
    """What the kernels know of a spline over evenly spaced knots, or over knots at given times [P]."""
    times = knot_dt * np.arange(count) if times is None else np.asarray(times)
    return spline_table(list(SplineKind)[KINDS.index(kind)], times, knot_dt, device)


def controls(
    knots, *, kind, knot_dt=1.0, times=None, control_dt=1.0, steps, offset=0.0, domains=1, limit=1e6, first=0, device
) -> np.ndarray:
    """Run the kernel on knots [E, S, P, nu]; returns controls [T, W, nu], NaN for worlds before ``first``."""
    knots = np.asarray(knots, dtype=np.float32)
    envs, samples, _, nu = knots.shape
    worlds = envs * samples * domains
    control = wp.full((steps, worlds, nu), np.nan, dtype=float, device=device)
    limits = [wp.full(nu, sign * limit, dtype=float, device=device) for sign in (-1.0, 1.0)]
    spline = table(kind, knots.shape[2], knot_dt=knot_dt, times=times, device=device)
    t = control_dt * np.arange(steps)
    step = [wp.array(a, dtype=float, device=device) for a in (t, np.arange(steps) * (control_dt / spline.knot_dt))]
    since = wp.full(envs, offset, dtype=float, device=device)
    wp.launch(
        spline_control_kernel,
        dim=(2, worlds - first),
        inputs=[wp.array(knots, dtype=float, device=device), spline, *limits, *step, since, domains, first, 2],
        outputs=[control],
        device=device,
    )
    return control.numpy()


def shifted(mean, *, kind, shift, knot_dt=1.0, times=None, device) -> np.ndarray:
    """The plan [E, P, nu] re-sampled ``shift`` seconds later, one for all environments or each its own."""
    before = wp.array(np.asarray(mean, dtype=np.float32), dtype=float, device=device)
    after = wp.empty_like(before)
    spline = table(kind, before.shape[1], knot_dt=knot_dt, times=times, device=device)
    by = wp.array(np.broadcast_to(shift, before.shape[0]), dtype=float, device=device)
    wp.launch(shift_knots_kernel, dim=after.shape, inputs=[before, spline, kind, by], outputs=[after], device=device)
    return after.numpy()


def advanced(kind, elapsed, *, offset=0.0, knot_dt=1.0, times=None, device) -> tuple[float, float]:
    """Time from the first knot to the present, and how far the knots move, after this time."""
    arrays = [wp.full(1, value, dtype=float, device=device) for value in (elapsed, offset, 0.0)]
    spline = table(kind, 5, knot_dt=knot_dt, times=times, device=device)
    wp.launch(advance_plan_kernel, dim=1, inputs=[spline, arrays[0]], outputs=arrays[1:], device=device)
    return tuple(float(array.numpy()[0]) for array in arrays[1:])


def command(mean, *, kind, time, knot_dt=1.0, times=None, limit=1e6, device) -> np.ndarray:
    """The control [E, nu] of the plan [E, P, nu] at this time."""
    mean = wp.array(np.asarray(mean, dtype=np.float32), dtype=float, device=device)
    out = wp.empty((mean.shape[0], mean.shape[2]), dtype=float, device=device)
    limits = [wp.full(mean.shape[2], sign * limit, dtype=float, device=device) for sign in (-1.0, 1.0)]
    spline = table(kind, mean.shape[1], knot_dt=knot_dt, times=times, device=device)
    offset = wp.full(mean.shape[0], time, dtype=float, device=device)
    wp.launch(command_kernel, dim=out.shape, inputs=[mean, spline, *limits, offset], outputs=[out], device=device)
    return out.numpy()


def some_knots(seed: int, *shape: int) -> np.ndarray:
    """Random knots of this shape, as float32 holds them."""
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [1, 2, 3, 4, 9])
def test_controls_match_scipy_in_every_world(kind, count, device):
    knots = some_knots(count, 2, 3, count, 2)
    control = controls(knots, kind=kind, knot_dt=0.1, control_dt=0.04, steps=24, domains=2, device=device)

    expected = reference_spline(knots.astype(np.float64).transpose(2, 0, 1, 3), kind, 0.4 * np.arange(24))
    expected = np.repeat(expected[:, :, :, None], 2, axis=3)  # [T, E, S, D, nu]: world (e·S + s)·D + d
    np.testing.assert_allclose(control, expected.reshape(24, 12, 2), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("control_dt", [0.01, 0.02, 0.04, 0.1, 1.0 / 30.0])
def test_a_zero_order_knot_per_control_is_the_control(control_dt, device):
    knots = some_knots(0, 1, 2, 64, 1)
    control = controls(knots, kind=ZERO, knot_dt=control_dt, control_dt=control_dt, steps=64, device=device)
    np.testing.assert_array_equal(control, knots[0].transpose(1, 0, 2))


@pytest.mark.parametrize("per_knot", [3, 5, 7, 10])
def test_a_zero_order_knot_holds_for_whole_controls(per_knot, device):
    knots = np.arange(40, dtype=np.float32).reshape(1, 1, 40, 1)
    control = controls(knots, kind=ZERO, knot_dt=0.02 * per_knot, control_dt=0.02, steps=40 * per_knot, device=device)
    np.testing.assert_array_equal(control[:, 0, 0], np.repeat(np.arange(40), per_knot))


@given(kind=st.sampled_from(KINDS), value=st.floats(-100.0, 100.0), time=st.floats(-3.0, 12.0), count=st.integers(1, 8))
def test_a_constant_plan_commands_that_constant(kind, value, time, count, device):
    assert command(np.full((1, count, 1), value), kind=kind, time=time, device=device)[0, 0] == pytest.approx(
        value, rel=1e-5, abs=1e-6
    )


@pytest.mark.parametrize("kind", [LINEAR, CUBIC, BSPLINE])
@given(slope=st.floats(-10.0, 10.0), time=st.floats(0.0, 6.0))
def test_a_ramp_is_reproduced_to_its_ends(kind, slope, time, device):
    ramp = slope * np.arange(7.0).reshape(1, 7, 1)
    assert command(ramp, kind=kind, time=time, device=device)[0, 0] == pytest.approx(slope * time, rel=1e-4, abs=1e-4)


@given(
    kind=st.sampled_from([ZERO, LINEAR, BSPLINE]),
    seed=st.integers(0, 2**31 - 1),
    count=st.integers(1, 6),
    time=st.floats(-2.0, 8.0),
)
def test_values_stay_within_the_hull_of_the_knots(kind, seed, count, time, device):
    knots = some_knots(seed, 1, count, 1)
    value = command(knots, kind=kind, time=time, device=device)[0, 0]
    assert knots.min() - 1e-5 <= value <= knots.max() + 1e-5


@pytest.mark.parametrize("kind", KINDS)
@given(seed=st.integers(0, 2**31 - 1), count=st.integers(1, 8), beyond=st.floats(0.0, 50.0))
def test_ends_are_interpolated_and_held(kind, seed, count, beyond, device):
    knots = some_knots(seed, 1, count, 2)
    np.testing.assert_allclose(command(knots, kind=kind, time=-beyond, device=device), knots[:, 0], atol=1e-6)
    np.testing.assert_allclose(
        command(knots, kind=kind, time=count - 1 + beyond, device=device), knots[:, -1], atol=1e-6
    )


def test_controls_and_commands_are_clamped_where_the_spline_overshoots(device):
    knots = np.array([0.0, 0.0, 1.0, 1.0]).reshape(1, 4, 1)
    free = command(knots, kind=CUBIC, time=2.4, device=device)[0, 0]
    assert free > 1.01
    assert command(knots, kind=CUBIC, time=2.4, limit=1.0, device=device)[0, 0] == 1.0
    control = controls(knots[None], kind=CUBIC, control_dt=0.1, steps=31, limit=1.0, device=device)
    assert control.max() == 1.0


def test_commands_match_the_rolled_out_controls(device):
    knots = some_knots(1, 1, 1, 6, 3)
    for kind in KINDS:
        control = controls(knots, kind=kind, knot_dt=0.1, control_dt=0.03, steps=20, device=device)
        for t in (0, 4, 19):
            now = command(knots[0], kind=kind, time=0.03 * t, knot_dt=0.1, device=device)
            np.testing.assert_allclose(now, control[t], atol=1e-5)


@pytest.mark.parametrize("dt", [0.01, 0.04, 1.0 / 30.0])
def test_a_zero_order_plan_shifts_by_one_control(dt, device):
    mean = some_knots(2, 2, 12, 3)
    expected = np.concatenate([mean[:, 1:], mean[:, -1:]], axis=1)
    np.testing.assert_array_equal(shifted(mean, kind=ZERO, shift=dt, knot_dt=dt, device=device), expected)


@pytest.mark.parametrize("kind", KINDS)
def test_no_shift_changes_nothing(kind, device):
    mean = some_knots(3, 2, 7, 2)
    np.testing.assert_array_equal(shifted(mean, kind=kind, shift=0.0, device=device), mean)


@given(kind=st.sampled_from(KINDS), seed=st.integers(0, 2**31 - 1), whole=st.integers(0, 12), place=st.floats(0.0, 1.0))
def test_a_plan_shifted_by_whole_knots_says_now_what_it_said_for_later(kind, seed, whole, place, device):
    mean = some_knots(seed, 1, 10, 1)
    later = shifted(mean, kind=kind, shift=float(whole), device=device)
    # the smooth kinds know one knot on either side of a segment, so their end segments may differ
    margin = 0 if kind in (ZERO, LINEAR) else 1
    last = 9 - whole - margin
    if last < margin:
        np.testing.assert_array_equal(
            later[0, max(9 - whole, 0) :], np.repeat(mean[0, -1:], min(whole + 1, 10), axis=0)
        )
        return
    time = margin + place * (last - margin)
    # a zero-order value jumps at its knots: stay off the rounding error around them
    time = np.floor(time) + 0.5 if kind == ZERO else time
    np.testing.assert_allclose(
        command(later, kind=kind, time=time, device=device),
        command(mean, kind=kind, time=time + whole, device=device),
        rtol=1e-4,
        atol=1e-5,
    )


@pytest.mark.parametrize("kind", [ZERO, LINEAR, CUBIC])
@given(seed=st.integers(0, 2**31 - 1), shift=st.floats(0.0, 12.0).filter(lambda x: abs(x - round(x)) > 1e-3))
def test_interpolating_kinds_are_resampled_at_the_new_knots(kind, seed, shift, device):
    mean = some_knots(seed, 2, 8, 2)
    expected = reference_spline(mean.astype(np.float64).transpose(1, 0, 2), kind, np.arange(8) + shift)
    later = shifted(mean, kind=kind, shift=0.1 * shift, knot_dt=0.1, device=device)
    np.testing.assert_allclose(later, expected.transpose(1, 0, 2), rtol=1e-4, atol=1e-4)


def test_repeated_shifts_do_not_smooth_a_bspline_plan_away(device):
    def wave(phase: float) -> np.ndarray:
        return np.sin(2.0 * np.pi * (np.arange(40) + phase) / 8.0).reshape(1, 40, 1)

    mean = wave(0.0)
    resampled = mean[0, :, 0]
    for _ in range(8):
        mean = shifted(mean, kind=BSPLINE, shift=0.25, device=device)
        resampled = reference_spline(resampled, BSPLINE, np.arange(40) + 0.25)
    inside = slice(4, 32)
    assert np.abs(resampled[inside] - wave(2.0)[0, inside, 0]).max() > 0.3  # what curve values would do
    np.testing.assert_allclose(mean[0, inside, 0], wave(2.0)[0, inside, 0], atol=0.1)


# knots that are not evenly spaced


UNEVEN = np.array([0.0, 0.1, 0.25, 0.3, 0.7, 0.9, 1.6])


def uneven_reference(knots: np.ndarray, kind: int, time: np.ndarray, times: np.ndarray = UNEVEN) -> np.ndarray:
    """Spline over knots [P, nu] at these times, by SciPy in float64; returns [n, nu]."""
    last = len(times) - 1
    time = np.clip(time, times[0], times[-1])
    if kind == ZERO:
        return knots[np.searchsorted(times, time + 1e-7, side="right") - 1]
    if kind == LINEAR:
        return np.stack([np.interp(time, times, column) for column in knots.T], axis=1)
    if kind == CUBIC:
        slope = np.diff(knots, axis=0) / np.diff(times)[:, None]
        slope = np.concatenate([slope[:1], 0.5 * (slope[:-1] + slope[1:]), slope[-1:]])
        return CubicHermiteSpline(times, knots, slope)(time)
    return reference_spline(knots, BSPLINE, np.interp(time, times, np.arange(last + 1)))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(3))
def test_controls_and_commands_over_uneven_knots_match_scipy(kind, seed, device):
    knots = some_knots(seed, 2, 3, len(UNEVEN), 2)
    control = controls(knots, kind=kind, times=UNEVEN, control_dt=0.043, steps=40, domains=2, device=device)
    for e, s in ((0, 0), (0, 2), (1, 1)):
        expected = uneven_reference(knots[e, s].astype(np.float64), kind, 0.043 * np.arange(40))
        for d in range(2):
            np.testing.assert_allclose(control[:, (e * 3 + s) * 2 + d], expected, atol=2e-5)
    for time in (-0.2, 0.0, 0.07, 0.29, 0.5, 1.2, 3.0):
        found = command(knots[:, 0], kind=kind, time=time, times=UNEVEN, device=device)
        expected = [uneven_reference(k.astype(np.float64), kind, np.array([time]))[0] for k in knots[:, 0]]
        np.testing.assert_allclose(found, expected, atol=2e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_evenly_spaced_knots_are_the_same_by_either_way_of_counting(kind, device):
    knots = some_knots(4, 1, 2, 7, 2)
    even = controls(knots, kind=kind, knot_dt=0.1, control_dt=0.033, steps=20, device=device)
    # the last knot a little late makes the grid uneven; long before it nothing of that shows
    times = [*(0.1 * np.arange(6)), 0.6001]
    uneven = controls(knots, kind=kind, times=times, control_dt=0.033, steps=20, device=device)
    early = 0.033 * np.arange(20) < 0.4
    np.testing.assert_allclose(uneven[early], even[early], atol=1e-5)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", KINDS)
def test_a_plan_over_uneven_knots_moves_by_the_time_that_has_passed(kind, seed, device):
    mean = some_knots(seed, 2, len(UNEVEN), 3)
    by = np.array([0.06, 0.33])
    found = shifted(mean, kind=kind, shift=by, times=UNEVEN, device=device)
    # zero-order values move between knots, or they would never move; control points are interpolated
    smooth = {ZERO: LINEAR, BSPLINE: CUBIC}.get(kind, kind)
    for e in range(2):
        expected = uneven_reference(mean[e].astype(np.float64), smooth, UNEVEN + by[e])
        np.testing.assert_allclose(found[e], expected, atol=3e-5)


def test_zero_order_knots_move_by_whole_intervals_and_the_rest_is_remembered(device):
    dt = 0.1
    offset, moved = 0.0, 0.0
    for n in range(1, 60):
        offset, by = advanced(ZERO, 0.03, offset=offset, knot_dt=dt, device=device)
        assert by == pytest.approx(dt * round(by / dt), abs=1e-6)
        moved += by
        assert 0.0 <= offset < dt - 1e-6
        assert moved + offset == pytest.approx(0.03 * n, abs=1e-4)
    assert advanced(ZERO, 0.25, offset=0.06, knot_dt=dt, device=device) == pytest.approx((0.01, 0.3), abs=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_other_plans_move_by_all_the_time_that_has_passed(kind, device):
    times = UNEVEN[:5] if kind == ZERO else None
    assert advanced(kind, 0.37, times=times, device=device) == pytest.approx((0.0, 0.37))


def test_only_the_worlds_asked_for_are_written(device):
    knots = some_knots(0, 2, 3, 4, 2)
    whole = controls(knots, kind=LINEAR, control_dt=0.4, steps=6, domains=2, device=device)
    part = controls(knots, kind=LINEAR, control_dt=0.4, steps=6, domains=2, first=5, device=device)
    assert np.isnan(part[:, :5]).all()
    np.testing.assert_array_equal(part[:, 5:], whole[:, 5:])


def test_rollouts_begin_some_time_after_the_first_knot(device):
    knots = some_knots(1, 1, 2, 6, 2)
    late = controls(knots, kind=LINEAR, knot_dt=0.1, control_dt=0.05, steps=6, offset=0.1, device=device)
    whole = controls(knots, kind=LINEAR, knot_dt=0.1, control_dt=0.05, steps=8, device=device)
    np.testing.assert_allclose(late, whole[2:], atol=1e-5)
