# SPDX-License-Identifier: Apache-2.0
"""Worlds that diverge: they stay where they were, are flagged, and change nothing in the others."""

import logging

import mujoco
import mujoco.rollout
import numpy as np
import pytest

from warpmpc.physics import BatchSimulator, rollout

MODEL = mujoco.MjModel.from_xml_string("""
<mujoco>
  <option timestep="0.02"/>
  <worldbody>
    <geom type="plane" size="5 5 .1"/>
    <body><joint name="x" type="slide" axis="1 0 0"/><geom size=".1" mass="1" contype="0" conaffinity="0"/></body>
    <body pos="0 0 1"><freejoint/><geom type="box" size=".1 .1 .1" mass="1"/></body>
    <body pos="1 0 1"><joint type="ball"/><geom size=".05" pos=".2 0 0" mass=".1"/></body>
  </worldbody>
  <actuator>
    <general name="unstable" joint="x" gainprm="50" biastype="affine" biasprm="0 -50 3"/>
    <motor joint="x" ctrlrange="-1 1"/>
    <general joint="x" dyntype="filter" dynprm=".1"/>
  </actuator>
  <sensor><jointpos joint="x"/><jointvel joint="x"/></sensor>
</mujoco>
""")
BAD = np.nan, np.inf, -np.inf, 2e10, -1e300
STEPS = 12
STATE = 1 + MODEL.nq + MODEL.nv + MODEL.na


def drawn(worlds, seed=0):
    """States around the model's own ``[W, nstate]``, and controls ``[W, T, nu]``."""
    rng = np.random.default_rng(seed)
    start = np.zeros((worlds, STATE))
    start[:, 1 : 1 + MODEL.nq] = MODEL.qpos0
    start[:, 1 + MODEL.nq :] = 0.1 * rng.normal(size=(worlds, MODEL.nv + MODEL.na))
    return start, 0.3 * rng.uniform(-1, 1, (worlds, STEPS, MODEL.nu))


def both(start, control):
    """States and readings of MuJoCo and ours, and which worlds diverged."""
    with mujoco.rollout.Rollout() as theirs, rollout.Rollout(fall_back=False) as ours:
        expected = theirs.rollout(MODEL, mujoco.MjData(MODEL), start, control)
        return expected, ours.rollout(MODEL, mujoco.MjData(MODEL), start, control), ours.diverged


@pytest.mark.parametrize("bad", BAD)
def test_a_start_that_is_no_number_is_mujocos_start(bad, caplog):
    start, control = drawn(STATE)
    for entry in range(1, 1 + MODEL.nq + MODEL.nv):
        start[entry, entry] = bad
    (state, sensed), (own, read), diverged = both(start, control)
    np.testing.assert_allclose(own[:-1], state[:-1], atol=1e-4)
    np.testing.assert_allclose(read[1:-1, 1:], sensed[1:-1, 1:], atol=1e-4)
    np.testing.assert_array_equal(diverged, (np.arange(STATE) > 0) & (np.arange(STATE) < 1 + MODEL.nq + MODEL.nv))
    lines = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert lines == [f"{diverged.sum()} of {STATE} worlds diverged and stay where they were"]


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("actuator", range(MODEL.nu))
def test_controls_that_are_no_numbers_are_zero_and_the_last(bad, actuator):
    start, control = drawn(STEPS)
    for step in range(STEPS):
        control[step, step, actuator] = bad
    (state, sensed), (own, read), diverged = both(start, control)
    np.testing.assert_allclose(own, state, atol=1e-4)
    np.testing.assert_allclose(read, sensed, atol=1e-4)
    assert diverged.all() == (actuator != 1 or np.isnan(bad))  # what is clamped is a number


def test_quaternions_of_no_length_are_no_rotation():
    start, control = drawn(3)
    start[0, 5:9], start[1, 9:13], start[2, 5:9] = 0.0, 0.0, (2.0, 0.0, 0.0, 1.0)
    (state, _), (own, _), diverged = both(start, control)
    np.testing.assert_allclose(own, state, atol=1e-4)
    assert not diverged.any()


def test_a_world_that_blows_up_stays_and_changes_no_other():
    start, control = drawn(21)
    control = np.repeat(control, 40, axis=1)
    quiet = control.copy()
    gone = np.isin(np.arange(21), (2, 3, 13))
    start[gone, 1 + MODEL.nq] = 3e9  # as fast as it may be; a second later it is beyond
    calm = start.copy()
    calm[gone] = start[0]
    (_, _), (own, read), diverged = both(start, control)
    (_, _), (others, read_others), _ = both(calm, quiet)
    np.testing.assert_array_equal(diverged, gone)
    np.testing.assert_array_equal(own[~gone], others[~gone])
    np.testing.assert_array_equal(read[~gone], read_others[~gone])
    assert np.isfinite(own).all()
    assert (abs(own) <= 1e10).all()
    np.testing.assert_array_equal(own[gone, -1], own[gone, -2])


def test_a_simulators_world_stays_until_it_is_reset():
    sim = BatchSimulator(MODEL, 5)
    control = np.zeros((5, MODEL.nu))
    sim.step(control)
    control[2, 0] = np.nan
    sim.step(control, n=3)
    control[2, 0] = 0.5
    here, read = sim.batch.work.initial.numpy()[2].copy(), sim.sensordata[2].copy()
    sim.step(control, n=3)
    np.testing.assert_array_equal(sim.diverged, np.arange(5) == 2)
    np.testing.assert_array_equal(sim.batch.work.initial.numpy()[2], here)
    np.testing.assert_array_equal(sim.sensordata[2], read)
    assert np.isfinite(sim.qpos).all()
    assert sim.time[2] < sim.time[1]
    sim.reset(np.arange(5) == 2)
    sim.step(control)
    assert not sim.diverged.any()
    assert sim.qpos[2, 0] != 0.0
