# SPDX-License-Identifier: Apache-2.0
"""Sensors that are read within a step, against ``mujoco.rollout`` and ``mj_forward``; rays; what is refused by name.

Slow ones by hand: pytest -m slow tests/physics/test_sensor_readings.py
"""

import mujoco
import mujoco.rollout
import numpy as np
import pytest
from native_robots import installed
from needs import needs
from sensed_models import BUSY, RAYS, drawn

from warpmpc.physics import BatchSimulator, rollout
from warpmpc.physics.sensors import unread_sensors

SENSOR = mujoco.mjtSensor
REFUSED = {
    SENSOR.mjSENS_GEOMDIST,
    SENSOR.mjSENS_GEOMNORMAL,
    SENSOR.mjSENS_GEOMFROMTO,
    SENSOR.mjSENS_TACTILE,
    SENSOR.mjSENS_PLUGIN,
    SENSOR.mjSENS_USER,
}


def readings(model, start, control):
    """Sensor readings ``[W, T, nsensordata]`` of MuJoCo, and ours."""
    data = mujoco.MjData(model)
    with rollout.Rollout(fall_back=False) as ours:
        own = ours.rollout(model, data, start, control)
    theirs = mujoco.rollout.rollout(model, data, start, control)
    np.testing.assert_allclose(own[0], theirs[0], atol=2e-4)
    return theirs[1], own[1]


def check(model, expected, found, close=2e-4):
    """Each sensor's readings agree to a share of their scale."""
    for n in range(model.nsensor):
        own = slice(model.sensor_adr[n], model.sensor_adr[n] + model.sensor_dim[n])
        scale = max(1.0, abs(expected[..., own]).max())
        apart = abs(found[..., own] - expected[..., own]).max() / scale
        assert apart < close, (n, SENSOR(model.sensor_type[n]).name, model.sensor(n).name, apart)


@pytest.mark.parametrize("integrator", [pytest.param("Euler", marks=pytest.mark.slow), "RK4"])  # implicitfast below
def test_forces_accelerations_contacts_and_limits_are_those_of_mujoco(integrator):
    model = mujoco.MjModel.from_xml_string(BUSY.replace("INTEGRATOR", integrator))
    touched = np.zeros(model.nsensordata, bool)
    for seed in range(3):
        start, control = drawn(model, seed, worlds=16, steps=3)
        expected, found = readings(model, start, control)
        check(model, expected, found)
        touched |= (expected != 0.0).any(axis=(0, 1))
    told = {SENSOR(kind) for kind in model.sensor_type[touched[model.sensor_adr]]}
    assert told == {SENSOR(kind) for kind in model.sensor_type}


def test_rays_meet_geoms_of_all_kinds():
    model = mujoco.MjModel.from_xml_string(RAYS)
    met = set()
    for seed in range(3):
        start, control = drawn(model, seed, worlds=64, steps=1)
        expected, found = readings(model, start, control)
        check(model, expected, found, 1e-5)
        data = mujoco.MjData(model)
        for row in start:
            data.qpos[:] = row[1 : 1 + model.nq]
            mujoco.mj_kinematics(model, data)
            for site in range(model.nsite):
                hit = np.array([-1], dtype=np.int32)
                along = data.site_xmat[site].reshape(3, 3)[:, 2].copy()
                mujoco.mj_ray(model, data, data.site_xpos[site], along, None, 1, model.site_bodyid[site], hit, None)
                met.add(int(model.geom_type[hit[0]]) if hit[0] >= 0 else -1)
    assert len(met) == 9, met  # of eight kinds, and nothing


def test_a_simulator_reads_what_the_state_that_it_has_reached_tells():
    model = mujoco.MjModel.from_xml_string(BUSY.replace("INTEGRATOR", "implicitfast"))
    start, control = drawn(model, 5, worlds=6, steps=1)
    sim = BatchSimulator(model, 6)
    at = start[:, 1 : 1 + model.nq + model.nv]
    sim.reset(qpos=at[:, : model.nq], qvel=at[:, model.nq :])
    begun = sim.sensordata.copy()
    sim.step(control[:, 0], n=2)
    state, expected, before = [], [], []
    for row, ctrl in zip(at, control[:, 0], strict=True):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = row[: model.nq], row[model.nq :]
        mujoco.mj_forward(model, data)
        before.append(data.sensordata.copy())
        data.ctrl[:] = ctrl
        mujoco.mj_step(model, data, 2)
        mujoco.mj_forward(model, data)
        state.append(data.qpos.copy())
        expected.append(data.sensordata.copy())
    check(model, np.array(before), begun)
    np.testing.assert_allclose(sim.qpos, state, atol=2e-4)
    check(model, np.array(expected), sim.sensordata, 2e-3)


def test_all_kinds_of_sensors_are_read_or_refused():
    """A kind that a newer MuJoCo has is in neither list: read it, or name it here."""
    models = [mujoco.MjModel.from_xml_string(text.replace("INTEGRATOR", "Euler")) for text in (BUSY, RAYS)]
    read = {SENSOR(kind) for model in models for kind in model.sensor_type}
    elsewhere = {"JOINTPOS", "JOINTVEL", "BALLQUAT", "BALLANGVEL", "FRAMEPOS", "FRAMEQUAT", "FRAMEXAXIS", "FRAMEYAXIS",
                 "FRAMEZAXIS", "FRAMELINVEL", "FRAMEANGVEL", "VELOCIMETER", "GYRO", "SUBTREECOM", "SUBTREELINVEL",
                 "CLOCK"}  # fmt: skip
    read |= {getattr(SENSOR, f"mjSENS_{name}") for name in elsewhere}  # of test_public_rollout.py
    assert not read & REFUSED
    assert read | REFUSED == set(SENSOR.__members__.values())


@pytest.mark.parametrize(
    ("sensor", "named"),
    [
        ('<user dim="2" needstage="vel"/>', "user"),
        ('<distance geom1="ball" geom2="plane" cutoff="1"/>', "geomdist"),
        ('<normal geom1="ball" geom2="plane" cutoff="1"/>', "geomnormal"),
        ('<fromto geom1="ball" geom2="plane" cutoff="1"/>', "geomfromto"),
        ('<rangefinder camera="eye"/>', "rangefinder (of a camera)"),
        ('<gyro site="beam" delay=".02" nsample="3"/>', "gyro (delay, interval)"),
    ],
)
def test_what_is_not_read_is_refused_by_name(sensor, named):
    text = RAYS.replace("<sensor>", f"<sensor>{sensor}").replace(
        '<site name="beam"', '<camera name="eye" resolution="4 4"/><site name="beam"'
    )
    model = mujoco.MjModel.from_xml_string(text)
    assert named in unread_sensors(model)
    assert rollout.lacking(model)
    with pytest.raises(ValueError, match=named.split(" ")[0]):
        BatchSimulator(model, 2)


def test_models_whose_sensors_are_off_are_stepped_all_the_same():
    off = '<option><flag sensor="disable"/></option><default>'
    text = RAYS.replace("<sensor>", '<sensor><user dim="2"/>').replace("<default>", off)
    model = mujoco.MjModel.from_xml_string(text)
    assert not rollout.lacking(model)
    sim = BatchSimulator(model, 2)
    sim.step()
    assert not sim.sensordata.any()


@needs("mjlab")
def test_an_arm_of_mjlab_as_it_is_has_room_for_its_contacts():
    model = mujoco.MjModel.from_xml_path(str(installed("mjlab", "asset_zoo/robots/i2rt_yam/xmls/yam.xml")))
    q = np.random.default_rng(0).uniform(*model.jnt_range.T, size=(200, model.nq))
    data, touching = mujoco.MjData(model), []
    for data.qpos[:] in q:
        mujoco.mj_forward(model, data)
        touching.append(data.ncon)
    assert max(touching) > 30
    sim = BatchSimulator(model, len(q))
    sim.reset(qpos=q)
    sim.step()
    assert not sim.overflow.any()
