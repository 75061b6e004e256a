# SPDX-License-Identifier: Apache-2.0
"""One bad measurement of any kind moves no estimate for long: at most twice the error before it half a second later."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from estimated_dog import dog, trot
from small_scenes import BOX, compiled, make_scene

from warpmpc import Plant, State
from warpmpc.loop.estimation.base_estimator import BaseEstimator
from warpmpc.loop.estimation.measurement import ImuMeasured, JointsMeasured, PoseMeasured
from warpmpc.loop.estimation.scene_estimator import PoseEstimator
from warpmpc.scene.model.compiled import compile_scene
from warpmpc.scene.schema_estimate import Estimate

BAD, END = 1.0, 2.0
"""When the bad measurement comes, and the end [s]."""


@pytest.fixture(scope="module")
def trotted():
    """Measurements and true states of a trot, the errors without a bad measurement, and what came before it."""
    scene = dog()
    plant = Plant(scene, seed=3)
    measured, states = [], []
    while plant.time < END:
        plant.observe()
        measured += plant.measured
        states.append(plant.state)
        plant.apply(trot(plant))
    entries = [(m.time, m) for m in measured]
    new = BaseEstimator("dog", scene.estimate_base["dog"], compile_scene(scene)), 0, []
    begun = estimated(new, entries, [state for state in states if state.time < BAD - 0.01])
    return begun, entries, states, errors(begun, entries, states)


def estimated(begun, measured, states):
    """Go on with a copy of an estimator, the measurements that it took, and its errors so far."""
    estimator, taken, out = deepcopy(begun)
    for state in states[len(out) :]:
        while taken < len(measured) and measured[taken][0] <= state.time + 1e-9:
            estimator.update(measured[taken][1])
            taken += 1
        found = estimator.fill(state)
        off = found.joint_qd[:3] - state.joint_qd[:3], found.joint_q[:3] - state.joint_q[:3], up(found) - up(state)
        trusted = estimator.trusted(float(state.time))
        out.append([np.linalg.norm(part) if trusted else np.nan for part in off])
    return estimator, taken, out


def errors(begun, measured, states) -> np.ndarray:
    """Errors of velocity [m/s], position [m] and tilt [rad] of the estimated base ``[n, 3]``, NaN where untrusted."""
    return np.array(estimated(begun, measured, states)[2])


def up(state) -> np.ndarray:
    """The base's vertical axis in the world."""
    x, y, z, w = state.joint_q[3:7].astype(float)
    return np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])


X = np.array([1.0, 0.0, 0.0])
UNIT = {
    "35 rad/s": lambda m: replace(m, gyro=m.gyro + 35.0 * X),
    "20 rad/s": lambda m: replace(m, gyro=m.gyro - 20.0 * X[[1, 0, 2]]),
    "300 rad/s": lambda m: replace(m, gyro=300.0 * X),
    "1e200 rad/s": lambda m: replace(m, gyro=1e200 * X),
    "1e9 m/s²": lambda m: replace(m, accel=1e9 * X),
    "200 m/s²": lambda m: replace(m, accel=m.accel + 200.0 * X),
    "not finite": lambda m: replace(m, accel=np.nan * X),
    "two numbers": lambda m: replace(m, gyro=m.gyro[:2]),
    "long ago": lambda m: replace(m, time=-1e200),
    "far ahead": lambda m: replace(m, time=1e200),
}
JOINTS = {
    "a coordinate": lambda m: replace(m, q=m.q + np.eye(12)[1]),
    "all coordinates zero": lambda m: replace(m, q=0.0 * m.q),
    "all velocities": lambda m: replace(m, qd=m.qd + 100.0),
    "all efforts": lambda m: replace(m, effort=m.effort + 1e6),
    "no efforts": lambda m: replace(m, effort=0.0 * m.effort),
    "no numbers": lambda m: replace(m, qd=np.full(12, np.nan)),
    "eleven joints": lambda m: replace(m, q=m.q[:11], qd=m.qd[:11], effort=m.effort[:11]),
}


@pytest.mark.parametrize(
    ("kind", "spoil"),
    [*((ImuMeasured, spoil) for spoil in UNIT.values()), *((JointsMeasured, spoil) for spoil in JOINTS.values())],
    ids=[*UNIT, *JOINTS],
)
def test_a_base_is_moved_by_no_bad_measurement(trotted, kind, spoil):
    begun, entries, states, good = trotted
    at = next(n for n, (time, m) in enumerate(entries) if isinstance(m, kind) and time >= BAD)
    spoilt = [*entries[:at], (entries[at][0], spoil(entries[at][1])), *entries[at + 1 :]]
    times = np.array([state.time for state in states])
    found = errors(begun, spoilt, states)
    before = good[times < BAD].max(axis=0)
    assert np.isfinite(found).all()  # a single one is left out: nothing is untrusted
    assert (found[times > BAD + 0.5] <= np.maximum(2.0 * before, 2.0 * good[times > BAD + 0.5])).all()
    assert (found[times >= BAD, 0] < before[0] + 0.1).all()


def test_a_unit_that_lies_is_made_up_for_by_feet(trotted):
    begun, entries, states, _ = trotted
    entries = list(entries)
    units = [n for n, (time, m) in enumerate(entries) if isinstance(m, ImuMeasured) and time >= BAD][:8]
    for n in units:
        entries[n] = entries[n][0], replace(entries[n][1], accel=entries[n][1].accel + 200.0 * X)
    found = errors(begun, entries, states)
    assert np.nanmax(found[:, 0]) < 0.25
    assert found[-1, 0] < 0.2


@pytest.mark.parametrize("frozen", [True, False])
def test_a_unit_that_is_frozen_or_silent_is_not_trusted_until_it_is_back(trotted, frozen):
    begun, entries, states, good = trotted
    (_, first), *_ = bad = [(t, m) for t, m in entries if isinstance(m, ImuMeasured) and BAD < t < BAD + 0.2]
    spoilt = [(t, m) for t, m in entries if not (isinstance(m, ImuMeasured) and BAD < t < BAD + 0.2)]
    if frozen:
        spoilt = sorted([*spoilt, *((t, replace(first, time=t)) for t, _ in bad)], key=lambda entry: entry[0])
    scene = dog()
    estimator = BaseEstimator("dog", scene.estimate_base["dog"], compile_scene(scene))
    refused = sum(not estimator.update(measured) for _, measured in spoilt)
    assert refused == (len(bad) - 4 if frozen else 0)  # all but the first ones, so that the state grows old
    times = np.array([state.time for state in states])
    late = errors(begun, spoilt, states)[times > BAD + 0.5]
    assert (late[:, [0, 2]] <= 2.0 * good[times < BAD].max(axis=0)[[0, 2]]).all()


@pytest.mark.parametrize(("kind", "count"), [("20 rad/s", 2), ("20 rad/s", 5), ("-5 rad/s", 5), ("200 m/s²", 5)])
def test_some_bad_measurements_in_a_row_leave_no_error(trotted, kind, count):
    begun, entries, states, good = trotted
    spoil = (UNIT | {"-5 rad/s": lambda m: replace(m, gyro=m.gyro - 5.0 * X)})[kind]
    entries = list(entries)
    for n in [n for n, (time, m) in enumerate(entries) if isinstance(m, ImuMeasured) and time >= BAD][:count]:
        entries[n] = entries[n][0], spoil(entries[n][1])
    times = np.array([state.time for state in states])
    found = errors(begun, entries, states)
    before, late = good[times < BAD].max(axis=0), found[times > BAD + 0.5]
    assert np.isfinite(late).all()
    assert (late <= 2.0 * np.maximum(before, good[times > BAD + 0.5])).all()
    assert np.nanmax(found[:, 0]) < before[0] + 0.1


POSES = {
    "no rotation": lambda m: replace(m, pose=np.r_[m.pose[:3], 0.0, 0.0, 0.0, 1e-200]),
    "1e308 m": lambda m: replace(m, pose=np.r_[1e308, m.pose[1:]]),
    "1e38 m": lambda m: replace(m, pose=np.r_[m.pose[:2], -1e38, m.pose[3:]]),
    "10 m": lambda m: replace(m, pose=m.pose + np.r_[10.0, np.zeros(6)]),
    "turned over": lambda m: replace(m, pose=np.r_[m.pose[:3], 1.0, 0.0, 0.0, 0.0]),
    "not finite": lambda m: replace(m, pose=np.full(7, np.nan)),
    "six numbers": lambda m: replace(m, pose=m.pose[:6]),
    "eight numbers": lambda m: replace(m, pose=np.r_[m.pose, 1.0]),
    "words": lambda m: replace(m, pose=np.array(["x"] * 7)),
    "long ago": lambda m: replace(m, time=-1e200),
    "far ahead": lambda m: replace(m, time=np.inf),
}


@pytest.mark.parametrize("estimate", [None, "constant_velocity", "constant_acceleration"])
@pytest.mark.parametrize("spoil", POSES.values(), ids=POSES)
def test_a_pose_is_moved_by_no_bad_measurement(spoil, estimate):
    scene = make_scene(object=[BOX])
    known = None if estimate is None else Estimate(model=estimate)
    rng, starts = np.random.default_rng(0), State.start(compiled(scene).layout)
    estimator, found, bad = PoseEstimator("box", known, scene, compiled(scene)), [], False
    joint = estimator._joint
    for n, time in enumerate(np.arange(0.0, 3.0, 0.01)):
        where = np.array([np.sin(time), np.cos(time), 0.1])
        if n % 3 == 0:
            pose = np.r_[where + 0.003 * rng.normal(size=3), 0.0, 0.0, np.sin(0.1 * time), np.cos(0.1 * time)]
            measured = PoseMeasured("box", time, pose)
            if not bad and time >= BAD:
                bad, measured = True, spoil(measured)
            estimator.update(measured)
        q = estimator.fill(replace(starts, time=time)).joint_q[joint.q]
        found.append(np.linalg.norm(q[:3] - where))
    found = np.array(found)
    assert np.isfinite(found).all()
    assert found[150:].max() < 2.0 * found[20:100].max()
    if estimate is not None:  # without a filter the box is where it was measured last
        assert found.max() < 0.2


@pytest.mark.parametrize("estimate", ["constant_velocity", "constant_acceleration"])
def test_a_pose_that_stays_the_same_is_refused_where_the_thing_moves(estimate):
    scene = make_scene(object=[BOX])
    estimator = PoseEstimator("box", Estimate(model=estimate), scene, compiled(scene))
    taken = []
    for n, speed in enumerate([0.0] * 10 + [0.5] * 30 + [0.0] * 10):
        pose = np.r_[0.0 if n < 10 else speed * n / 30.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0]
        taken.append(estimator.update(PoseMeasured("box", n / 30.0, pose)))
    assert all(taken[:40])  # what lies still is seen at the same place
    assert not all(taken[42:])
