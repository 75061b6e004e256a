# SPDX-License-Identifier: Apache-2.0
"""``warpmpc.physics.rollout`` against ``mujoco.rollout``: arrays, sensors, worlds that differ, what it lacks."""

import copy
import logging

import mujoco
import mujoco.rollout
import numpy as np
import pytest

from warpmpc.physics import rollout
from warpmpc.physics.sensors import unread_sensors

SEEN = """
<mujoco>
  <option timestep="0.004"/>
  <worldbody>
    <geom name="floor" type="plane" size="4 4 .1" contype="0" conaffinity="0"/>
    <camera name="fixed" pos="0 -1 1" euler="60 0 0"/>
    <body name="marker" mocap="true" pos=".3 .2 .5" quat=".8 0 .6 0">
      <site name="mark" pos=".1 0 0" euler="10 20 30"/>
    </body>
    <body name="torso" pos="0 0 1" quat=".9 .1 .3 .2">
      <freejoint/>
      <geom name="trunk" type="box" size=".1 .06 .04" pos=".01 .02 .03" euler="0 30 0" mass="2"/>
      <site name="imu" pos=".05 .01 .02" euler="20 40 10"/>
      <body name="upper" pos=".1 0 0" euler="5 10 15">
        <joint name="hip" axis="0 1 .2" ref=".3" damping=".3"/>
        <joint name="lift" type="slide" axis="0 0 1" damping="2"/>
        <geom type="capsule" size=".03" fromto="0 0 0 .2 0 .05" mass=".5"/>
        <camera name="eye" pos=".1 0 0" euler="0 90 0"/>
        <body name="lower" pos=".2 0 .05">
          <joint name="ball" type="ball" damping=".1"/>
          <geom name="tip" type="sphere" size=".04" pos=".1 0 0" mass=".3"/>
          <body name="welded" pos=".1 .1 0" euler="30 0 0">
            <geom type="sphere" size=".02" mass=".1"/><site name="end"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="hip" gear="2"/><position joint="lift" kp="20"/></actuator>
  <sensor>
    <jointpos joint="hip"/><jointvel joint="lift" cutoff=".05"/><ballquat joint="ball"/><ballangvel joint="ball"/>
    <clock/>
    <framepos objtype="site" objname="imu"/><framepos objtype="body" objname="torso" cutoff=".8"/>
    <framepos objtype="site" objname="end" reftype="xbody" refname="torso"/>
    <framepos objtype="geom" objname="tip" reftype="site" refname="mark"/>
    <framequat objtype="body" objname="torso"/><framequat objtype="xbody" objname="lower"/>
    <framequat objtype="site" objname="end" reftype="geom" refname="trunk"/>
    <framequat objtype="camera" objname="eye" reftype="camera" refname="fixed"/>
    <framexaxis objtype="site" objname="imu"/><frameyaxis objtype="geom" objname="trunk"/>
    <framezaxis objtype="camera" objname="eye" reftype="site" refname="imu"/>
    <framelinvel objtype="site" objname="end"/><framelinvel objtype="body" objname="torso"/>
    <framelinvel objtype="geom" objname="tip" reftype="site" refname="imu"/>
    <frameangvel objtype="body" objname="lower"/>
    <frameangvel objtype="site" objname="end" reftype="xbody" refname="upper"/>
    <velocimeter site="imu"/><gyro site="end"/>
    <subtreecom body="torso"/><subtreecom body="upper"/><subtreelinvel body="torso"/>
    <framepos objtype="xbody" objname="marker"/><framequat objtype="site" objname="mark"/>
  </sensor>
</mujoco>
"""
PUSHED = """
<mujoco>
  <worldbody>
    <geom type="plane" size="4 4 .1"/>
    <body pos="0 0 .1"><freejoint/><geom type="box" size=".1 .1 .1" mass="1"/></body>
    <body pos="-.5 0 .1"><joint name="x" type="slide" axis="1 0 0"/><geom type="sphere" size=".08" mass="1"/></body>
  </worldbody>
  <actuator><motor joint="x"/></actuator>
  <sensor>SENSORS<framepos objtype="geom" objname="g"/></sensor>
</mujoco>
""".replace('mass="1"/></body>\n    <body pos="-.5', 'mass="1" name="g"/></body>\n    <body pos="-.5')
WORLDS, STEPS = 21, 12
CLOSE = {"rtol": 5e-5, "atol": 5e-5}
"""Single precision, after as many steps."""


@pytest.fixture(scope="module")
def seen():
    """A model with all kinds of sensors of positions and velocities, and states and controls for it."""
    model = mujoco.MjModel.from_xml_string(SEEN)
    return model, *drawn(model, 3)


def drawn(model, seed, worlds=WORLDS, steps=STEPS):
    """States ``[W, nstate]`` around the model's, and controls ``[W, T, nu]``."""
    rng = np.random.default_rng(seed)
    data = mujoco.MjData(model)
    rows = []
    for _ in range(worlds):
        mujoco.mj_resetData(model, data)
        mujoco.mj_integratePos(model, data.qpos, rng.normal(size=model.nv), 0.3)
        rows.append([rng.uniform(0, 5), *data.qpos, *rng.normal(size=model.nv), *rng.uniform(-1, 1, model.na)])
    return np.array(rows), rng.uniform(-1, 1, (worlds, steps, model.nu))


def both(model, *args, threads=2, **kwargs):
    """States and readings of MuJoCo, and ours, which must not fall back."""
    datas = [mujoco.MjData(model if isinstance(model, mujoco.MjModel) else model[0]) for _ in range(threads)]
    with mujoco.rollout.Rollout(nthread=threads) as theirs, rollout.Rollout(nthread=threads, fall_back=False) as ours:
        return theirs.rollout(model, datas, *args, **kwargs), ours.rollout(model, datas, *args, **kwargs)


@pytest.mark.parametrize("seed", range(3))
def test_states_and_all_sensors_are_those_of_mujoco(seen, seed):
    model, (start, control) = seen[0], drawn(seen[0], seed)
    (state, sensed), (own_state, own_sensed) = both(model, start, control)
    assert not unread_sensors(model)
    np.testing.assert_allclose(own_state, state, **CLOSE)
    np.testing.assert_allclose(own_sensed, sensed, **CLOSE)


def test_time_is_as_precise_as_a_double(seen):
    model, start, control = seen
    start = start.copy()
    start[:, 0] = 1.7e9 + np.arange(WORLDS)
    (state, _), (own, _) = both(model, start, control)
    np.testing.assert_allclose(own[..., 0], state[..., 0], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("start", "control", "more"),
    [
        (slice(0, 1), np.s_[:], {}),  # one state for all
        (slice(None), np.s_[:1, :1], {"nstep": 4}),  # one control for all worlds and steps
        (0, np.s_[0], {}),  # fewer dimensions
    ],
)
def test_arrays_are_repeated_as_mujoco_does(seen, start, control, more):
    model = seen[0]
    (state, sensed), (own_state, own_sensed) = both(model, seen[1][start], seen[2][control], **more)
    assert (own_state.shape, own_sensed.shape) == (state.shape, sensed.shape)
    np.testing.assert_allclose(own_state, state, **CLOSE)


def test_no_control_is_zero_control(seen):
    (state, _), (own, _) = both(seen[0], seen[1], nstep=3)
    np.testing.assert_allclose(own, state, **CLOSE)


def test_results_are_written_into_given_arrays(seen):
    model, start, control = seen
    nstate = start.shape[1]
    state, sensed = np.full((WORLDS, STEPS, nstate), 7.0), np.full((WORLDS, STEPS, model.nsensordata), 7.0)
    datas = [mujoco.MjData(model)]
    found = rollout.rollout(model, datas, start, control, state=state, sensordata=sensed)
    assert [a is b for a, b in zip(found, (state, sensed), strict=True)] == [True, True]
    expected = mujoco.rollout.rollout(model, datas, start, control)
    np.testing.assert_allclose(state, expected[0], **CLOSE)
    loose = np.full((WORLDS, STEPS, 2 * nstate), 7.0)[..., ::2]
    with rollout.Rollout() as ours:  # arrays that no row of a rollout fills as they are
        ours.rollout(model, datas, start, control, nstep=STEPS, state=loose, sensordata=sensed, skip_checks=True)
    np.testing.assert_array_equal(loose, state)


def test_a_second_rollout_does_not_write_into_results_of_the_first(seen):
    model, start, control = seen
    with rollout.Rollout() as ours:
        first, _ = ours.rollout(model, mujoco.MjData(model), start, control)
        kept = first.copy()
        for _ in range(3):
            ours.rollout(model, mujoco.MjData(model), start, -control)
        np.testing.assert_array_equal(first, kept)
        again, _ = ours.rollout(model, mujoco.MjData(model), start, control)
    np.testing.assert_array_equal(again, first)


def test_a_changed_model_is_seen(seen):
    model, start, control = copy.copy(seen[0]), *seen[1:]
    with rollout.Rollout(fall_back=False) as ours:
        before, _ = ours.rollout(model, mujoco.MjData(model), start, control)
        for change in ("body_mass", "dof_damping", "actuator_gainprm"):
            getattr(model, change)[...] *= 1.5
            mujoco.mj_setConst(model, mujoco.MjData(model))
            after, _ = ours.rollout(model, mujoco.MjData(model), start, control)
            expected, _ = mujoco.rollout.rollout(model, mujoco.MjData(model), start, control)
            assert abs(after - before).max() > 1e-3
            np.testing.assert_allclose(after, expected, **CLOSE)
            before = after
        model.opt.gravity[2] = 0.0
        after, _ = ours.rollout(model, mujoco.MjData(model), start, control)
        expected, _ = mujoco.rollout.rollout(model, mujoco.MjData(model), start, control)
    np.testing.assert_allclose(after, expected, **CLOSE)


def pushed(sensors=""):
    """A model with contact, and states that a box lies in and a ball flies at it."""
    model = mujoco.MjModel.from_xml_string(PUSHED.replace("SENSORS", sensors))
    start, control = drawn(model, 0)
    start[:, 1:] = mujoco.MjData(model).qpos.tolist() + [0.0] * model.nv
    start[:, 8] = np.linspace(-0.05, 0.3, WORLDS)
    start[:, -1] = 1.5
    return model, start, control


def test_worlds_may_differ_in_mass_friction_and_size():
    model, start, control = pushed()
    rng, models = np.random.default_rng(0), []
    for _ in range(WORLDS):
        one = copy.copy(model)
        one.body_mass[1] *= (scale := rng.uniform(0.5, 2.0))
        one.body_inertia[1] *= scale
        one.geom_friction[:2, 0] = rng.uniform(0.2, 1.0)
        one.geom_size[1] *= (size := rng.uniform(0.9, 1.0))
        one.geom_aabb[1, 3:] *= size
        one.geom_rbound[1] *= size
        mujoco.mj_setConst(one, mujoco.MjData(one))
        models.append(one)
    (state, _), (own, _) = both(models, start, np.repeat(control, 6, axis=1))
    assert np.ptp(state[:, -1, 1]) > 0.05
    apart = abs(own - state)[:, -1].max(axis=1)
    assert np.median(apart) < 1e-4, apart
    assert apart.max() < 0.05, apart  # contacts that begin a step apart
    again = [copy.copy(m) for m in models]
    for one in again:
        one.body_mass[1] *= 2.0
        mujoco.mj_setConst(one, mujoco.MjData(one))
    with rollout.Rollout(fall_back=False) as ours:  # other numbers, the same source
        ours.rollout(models, mujoco.MjData(model), start, control)
        heavier, _ = ours.rollout(again, mujoco.MjData(model), start, control)
    expected, _ = mujoco.rollout.rollout(again, mujoco.MjData(model), start, control)
    assert np.median(abs(heavier - expected)[:, -1].max(axis=1)) < 1e-4


def test_a_warm_start_changes_no_result():
    model, start, control = pushed()
    (plain, _), (own, _) = both(model, start, control)
    (_, _), (warm, _) = both(model, start, control, initial_warmstart=np.full((WORLDS, model.nv), 3.0))
    np.testing.assert_allclose(warm, own, atol=1e-4)
    np.testing.assert_allclose(own, plain, atol=1e-3)


@pytest.mark.parametrize(
    ("sensors", "named"),
    [('<user dim="1"/>', "user"), ('<rangefinder camera="s"/>', "rangefinder")],
)
def test_what_it_lacks_is_rolled_out_by_mujoco_with_one_line(caplog, sensors, named):
    model, start, control = pushed()
    text = PUSHED.replace("SENSORS", sensors).replace("<freejoint/>", '<freejoint/><camera name="s" resolution="2 2"/>')
    model = mujoco.MjModel.from_xml_string(text)
    with caplog.at_level(logging.INFO, "warpmpc"), rollout.Rollout() as ours:
        for _ in range(2):
            found, sensed = ours.rollout(model, mujoco.MjData(model), start, control)
    expected = mujoco.rollout.rollout(model, mujoco.MjData(model), start, control)
    np.testing.assert_array_equal(found, expected[0])
    np.testing.assert_array_equal(sensed, expected[1])
    lines = [r.getMessage() for r in caplog.records if "MuJoCo's own" in r.getMessage()]
    assert [named in line for line in lines] == [True]
    with rollout.Rollout(fall_back=False) as strict, pytest.raises(ValueError, match=named):
        strict.rollout(model, mujoco.MjData(model), start, control)


CARRIED = """
<mujoco>
  <worldbody>
    <geom type="plane" size="4 4 .1"/>
    <body name="other" mocap="true" pos="1 0 1" quat="1 1 0 0"><site name="mark"/></body>
    <body name="hand" mocap="true" pos="0 0 .6"><geom type="box" size=".1 .1 .02"/>
      <body pos="0 .3 0">
        <joint name="swing" axis="1 0 0" damping=".1"/><geom type="sphere" size=".03" mass=".2"/>
      </body>
    </body>
    <body name="load" pos="0 0 .4"><freejoint/><geom type="box" size=".05 .04 .03" mass=".3" friction=".6"/></body>
    <body pos="0 0 .7"><joint name="ball" type="free"/><geom type="sphere" size=".04" mass=".1"/></body>
  </worldbody>
  <equality><weld body1="hand" body2="load"/></equality>
  <actuator><motor joint="swing" gear=".05"/></actuator>
  <sensor><framepos objtype="site" objname="mark"/><framequat objtype="body" objname="hand"/></sensor>
</mujoco>
"""
STATE = mujoco.mjtState
POSES = int(STATE.mjSTATE_MOCAP_POS | STATE.mjSTATE_MOCAP_QUAT)


@pytest.mark.parametrize(
    "spec",
    [int(STATE.mjSTATE_CTRL) | POSES, POSES, int(STATE.mjSTATE_CTRL | STATE.mjSTATE_MOCAP_POS)],
    ids=["all", "poses", "positions"],
)
def test_mocap_bodies_move_along_with_the_controls(spec):
    model = mujoco.MjModel.from_xml_string(CARRIED)
    start, ctrl = drawn(model, 4)
    start[:, 1:] = [*model.qpos0, *np.zeros(model.nv)]
    rng = np.random.default_rng(5)
    place = np.array([1.0, 0.0, 1.0, 0.0, 0.0, 0.6]) + 0.01 * rng.normal(size=(WORLDS, STEPS, 6)).cumsum(axis=1)
    turn = np.array([1.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]) + 0.02 * rng.normal(size=(WORLDS, STEPS, 8)).cumsum(
        axis=1
    )
    given = {STATE.mjSTATE_CTRL: ctrl, STATE.mjSTATE_MOCAP_POS: place, STATE.mjSTATE_MOCAP_QUAT: 2.0 * turn}
    control = np.concatenate([values for bit, values in given.items() if spec & int(bit)], axis=-1)
    (state, sensed), (own, read) = both(model, start, control, control_spec=spec)
    assert abs(state[:, -1, 1:] - start[:, 1:]).max() > 0.01
    np.testing.assert_allclose(own, state, rtol=2e-4, atol=2e-4)
    np.testing.assert_allclose(read, sensed, **CLOSE)


def test_other_controls_than_ctrl_are_rolled_out_by_mujoco():
    model, start, control = pushed()
    spec = int(mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_QFRC_APPLIED)
    force = np.concatenate([control, np.ones((*control.shape[:2], model.nv))], axis=-1)
    expected = mujoco.rollout.rollout(model, mujoco.MjData(model), start, force, control_spec=spec)
    found = rollout.rollout(model, mujoco.MjData(model), start, force, control_spec=spec)
    np.testing.assert_array_equal(found[0], expected[0])


def test_bad_shapes_are_mujocos_errors(seen):
    model, start, control = seen
    with pytest.raises(ValueError, match="trailing dimension of initial_state"):
        rollout.rollout(model, mujoco.MjData(model), start[:, 1:], control)
    pool = rollout.Rollout(nthread=2)
    pool.close()
    with pytest.raises(RuntimeError, match="shutdown"):
        pool.rollout(model, mujoco.MjData(model), start, control)


CALLBACKS = sorted(name.removeprefix("get_") for name in dir(mujoco) if name.startswith("get_mjcb_"))


@pytest.mark.parametrize("callback", [name for name in CALLBACKS if name != "mjcb_time"])
def test_mujoco_rolls_out_while_a_callback_is_installed(callback, caplog):
    model, start, control = pushed()
    expected, install = both(model, start, control)[1], getattr(mujoco, f"set_{callback}")
    install(lambda *_: 0)
    try:
        with caplog.at_level(logging.INFO, "warpmpc"), rollout.Rollout() as ours:
            found = [ours.rollout(model, mujoco.MjData(model), start, control)[0] for _ in range(2)]
        theirs, _ = mujoco.rollout.rollout(model, mujoco.MjData(model), start, control)
        np.testing.assert_array_equal(found, [theirs, theirs])
        assert [callback in r.getMessage() for r in caplog.records if "MuJoCo's own" in r.getMessage()] == [True]
        with rollout.Rollout(fall_back=False) as strict, pytest.raises(ValueError, match=callback):
            strict.rollout(model, mujoco.MjData(model), start, control)
    finally:
        install(None)
    with rollout.Rollout(fall_back=False) as ours:
        again, _ = ours.rollout(model, mujoco.MjData(model), start, control)
    np.testing.assert_array_equal(again, expected[0])


@pytest.mark.parametrize("which", ["state", "sensordata"])
def test_an_array_that_is_read_only_is_an_error(which):
    model, start, control = pushed()
    (state, sensordata), _ = both(model, start, control)
    out = {"state": state, "sensordata": sensordata}[which]
    out[...] = 7.0
    out.flags.writeable = False
    with rollout.Rollout(fall_back=False) as ours, pytest.raises((ValueError, TypeError)):
        ours.rollout(model, mujoco.MjData(model), start, control, **{which: out})
    assert (out == 7.0).all()


def test_data_hold_controls_and_are_left_after_the_last_step(seen):
    model, start, control = seen
    for given in (None, control):
        theirs, ours = mujoco.MjData(model), mujoco.MjData(model)
        theirs.ctrl, ours.ctrl = 0.7, 0.7
        expected = mujoco.rollout.rollout(model, theirs, start, given, nstep=STEPS)
        found = rollout.rollout(model, ours, start, given, nstep=STEPS)
        np.testing.assert_allclose(found[0], expected[0], **CLOSE)
        for name in ("time", "qpos", "qvel", "ctrl", "xpos", "sensordata"):
            np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), atol=1e-4, err_msg=name)


@pytest.mark.parametrize("field", ["dof_damping", "actuator_gainprm", "body_ipos"])
def test_models_that_differ_in_more_are_rolled_out_by_mujoco_with_its_name(caplog, field):
    model, start, control = pushed()
    models = [copy.copy(model) for _ in range(WORLDS)]
    for number, one in enumerate(models):
        getattr(one, field)[...] += 0.01 * number
    with caplog.at_level(logging.INFO, "warpmpc"), rollout.Rollout() as ours:
        for _ in range(2):
            ours.rollout(models, mujoco.MjData(model), start, control)
    assert [field in record.getMessage() for record in caplog.records] == [True]
