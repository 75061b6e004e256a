# SPDX-License-Identifier: Apache-2.0
"""``Batch`` against ``mujoco.batch.Batch``: steps, rollouts, outputs, own numbers, and what MuJoCo's steps are for."""

import logging
from concurrent.futures import ThreadPoolExecutor

import mujoco
import mujoco.batch
import numpy as np
import pytest

from warpmpc.physics import Batch

TEXT = """
<mujoco>
  <option timestep="0.005" iterations="100" tolerance="0"/>
  <worldbody>
    <geom type="plane" size="4 4 .1" friction=".6"/>
    <body name="base" pos="-.6 0 .15">
      <joint name="x" type="slide" axis="1 0 0" damping="1"/><joint axis="0 0 1" damping=".2"/>
      <geom name="stick" type="capsule" size=".05" fromto="0 0 0 .3 0 0" mass="1"/>
      <site name="end" pos=".3 0 0" euler="0 30 0"/>
      <camera pos="0 .1 0" euler="10 0 0"/>
    </body>
    <body name="box" pos="0 0 .1">
      <freejoint/><geom type="box" size=".1 .08 .1" mass=".7" friction=".5"/>
    </body>
    <body name="hand" mocap="true" pos=".3 0 .12">
      <geom type="box" size=".05 .2 .05"/><body pos="0 0 .1"><geom size=".01" pos=".1 0 0"/></body>
    </body>
  </worldbody>
  <actuator>
    <position joint="x" kp="60" kv="5"/>
    <general site="end" gear="0 10 0 0 0 0" dyntype="filter" dynprm=".05"/>
  </actuator>
  <sensor><clock/><framepos objtype="site" objname="end"/><velocimeter site="end"/></sensor>
</mujoco>
"""
OUTPUTS = ("xpos", "xquat", "xmat", "xipos", "ximat", "geom_xpos", "geom_xmat", "site_xpos", "site_xmat", "cam_xpos",
           "cam_xmat", "sensordata")  # fmt: skip
SIMS = 19


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(TEXT)


def pair(model, seed, **options):
    """Our batch and MuJoCo's, in the same random states, with the same controls and poses of the hand."""
    out, rng = [Batch(model, SIMS, 2, **options), mujoco.batch.Batch(model, SIMS, 2)], np.random.default_rng(seed)
    one = out[0]
    one.qpos[:, :2] += rng.uniform(-0.1, 0.1, (SIMS, 2))
    one.qvel[:, 0] = rng.uniform(0.0, 1.0, SIMS)
    one.ctrl[:] = rng.uniform(-1.0, 1.0, one.ctrl.shape)
    one.mocap_pos[..., 0] -= rng.uniform(0.0, 0.25, (SIMS, 1))
    one.mocap_quat[:] = rng.normal(size=one.mocap_quat.shape)
    one.mocap_quat[0] = 0.0
    out[1].state[:] = one.state
    return out


def agree(a, b, atol=5e-4):
    """Compare the whole states but for the accelerations that solvers begin with, and what is bound."""
    for name in ("time", "qpos", "qvel", "act", "ctrl", "mocap_pos", "mocap_quat", *a._bound):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=20 * atol if name == "qvel" else atol)


@pytest.mark.parametrize("seed", range(2))
def test_steps_and_outputs_are_those_of_mujoco(model, seed, caplog):
    batches, rng = pair(model, seed), np.random.default_rng(seed)
    start = batches[0].qpos.copy()
    with caplog.at_level(logging.WARNING, "warpmpc"):
        for nstep in (1, 4, 1, 7):
            ids = rng.random(SIMS) < 0.7
            for batch in batches:
                for name in OUTPUTS:
                    batch.bind(name)
                batch.step(ids if nstep == 4 else None, nstep)
            agree(*batches)
    assert not caplog.records
    assert abs(batches[0].qpos - start)[:, 2].max() > 0.01  # boxes were pushed


@pytest.mark.parametrize("control", [None, "CTRL", "MOCAP_POS", "MOCAP_POS CTRL MOCAP_QUAT"])
def test_rollouts_are_those_of_mujoco(model, control, caplog):
    batches, rng, ids = pair(model, 0), np.random.default_rng(0), np.array([0, 3, 7, 11])
    spec = sum(int(getattr(mujoco.mjtState, f"mjSTATE_{name}")) for name in (control or "").split())
    given = None if control is None else rng.uniform(-0.5, 0.5, (4, 9, mujoco.mj_stateSize(model, spec)))
    user = int(mujoco.mjtState.mjSTATE_USER)
    record = ("qpos", "act", "eq_active", *OUTPUTS, user, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    with caplog.at_level(logging.WARNING, "warpmpc"):
        ours, theirs = (
            batch.rollout(9, given, *([spec] if control else []), record=record, ids=ids) for batch in batches
        )
    for item in record:
        assert ours[item].dtype == theirs[item].dtype
        np.testing.assert_allclose(ours[item], theirs[item], atol=5e-3)
    agree(*batches)
    assert not caplog.records


def test_simulations_have_numbers_of_their_own(model, caplog):
    batches, rng = pair(model, 1), np.random.default_rng(1)
    scale = rng.uniform(0.5, 2.0, (SIMS, 1))
    with caplog.at_level(logging.WARNING, "warpmpc"):
        for again in range(3):
            for batch in batches:
                batch.expand("body_mass")[:] *= scale
                batch.expand("body_inertia")[:] *= scale[..., None]
                batch.expand("geom_friction")[:, :, 0] /= scale
                batch.expand("opt.gravity")[:, 2] = -9.81 + again * scale[:, 0]
                batch.expand("actuator_gainprm")[:, 1] = 0.5
                batch.set_const()
                batch.step(nstep=5)
            agree(*batches)
    assert not caplog.records


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (lambda b: b.bind("qfrc_bias"), "output qfrc_bias"),
        (lambda b: b.xfrc_applied.__setitem__((3, 2, 0), 1.0), "applied forces"),
        (lambda b: b.qfrc_applied.__setitem__((3, 0), 1.0), "applied forces"),
        (lambda b: b.expand("dof_damping").__setitem__((3, 0), 2.0), "worlds that differ in dof_damping"),
        (lambda b: b.expand("opt.timestep").__setitem__(3, 0.001), "worlds that differ in opt.timestep"),
        (lambda b: b.set_models(b.model), "models of the caller"),
        (lambda b: b.expand("body_mass").__setitem__((3, 1), 1e300), "numbers of body_mass beyond single precision"),
    ],
)
@pytest.mark.parametrize("nstep", [1, 3])
def test_mujoco_takes_steps_with_one_line(model, change, cause, nstep, caplog):
    batches = pair(model, 2)
    with caplog.at_level(logging.WARNING, "warpmpc"):
        for batch in batches:
            change(batch)
            batch.step(nstep=nstep)
            batch.step(nstep=nstep)
    agree(*batches)
    assert [cause in line.getMessage() for line in caplog.records] == [True]
    refusing = Batch(model, SIMS, fall_back=False)
    change(refusing)
    with pytest.raises(ValueError, match=cause):
        refusing.step(nstep=nstep)


@pytest.mark.parametrize(
    ("nstep", "error"), [(2**31, TypeError), (2**63, TypeError), (1.5, TypeError), (0, None), (-1, None)]
)
def test_a_number_of_steps_that_is_none_is_an_error_as_in_mujoco(model, nstep, error):
    for batch in pair(model, 0):
        with pytest.raises(error or mujoco.FatalError):
            batch.step(nstep=nstep)


def test_simulations_that_diverge_are_reset_by_mujoco(model):
    batches = pair(model, 3)
    for batch in batches:
        batch.qvel[2, 0], batch.ctrl[5, 1], batch.qpos[7, 3] = np.nan, np.inf, 1e11
        for name in OUTPUTS:
            batch.bind(name)
        batch.step(nstep=4)
    agree(*batches)
    np.testing.assert_array_equal(batches[0].warning[..., 1], batches[1].warning[..., 1])
    assert batches[0].warning[[2, 5, 7], :, 1].any(axis=1).all()


def test_calls_of_several_threads_wait_for_each_other(model):
    batches = pair(model, 4)
    for name in OUTPUTS:
        assert batches[0].bind(name).shape == batches[1].bind(name).shape
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda _: batches[0].step(), range(24)))
    for _ in range(24):
        batches[1].step()
    agree(*batches, atol=2e-3)
