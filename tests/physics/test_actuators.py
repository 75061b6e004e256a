# SPDX-License-Identifier: Apache-2.0
"""Transmissions, muscles, tendons around shapes, and kinds of actuators by name, against MuJoCo C.

Slow ones by hand: pytest -m slow tests/physics/test_actuators.py
"""

import mujoco
import mujoco.rollout
import numpy as np
import pytest
from actuator_models import ARM, DEGENERATE, TRANSMISSIONS, shapes
from fused_models import compile_model, controls, starts
from fused_steps import public_differences, step_differences, visit
from needs import needs
from shared.plain_rollout import PlainRollout
from warp_lanes import LaneRollout

from warpmpc.physics import rollout
from warpmpc.physics.unsupported import KINDS, lacking_kinds, missing


def visited(model: mujoco.MjModel, seed: int, worlds: int = 8):
    q, v = starts(model, worlds, seed=seed)
    return visit([model], q, v, controls(model, 60, worlds, seed=seed), every=4)


@pytest.mark.parametrize("integrator", ["implicitfast", "Euler"])
def test_muscles_and_tendons_around_shapes_step_as_in_mujoco(integrator):
    """Activations too: `public_differences` compares them."""
    model = compile_model(ARM, integrator)
    for seed in range(2):
        found = public_differences(model, visited(model, seed))
        most = found.v.max(axis=1)
        assert most.max() <= 1e-3, found
        assert np.percentile(most, 99) <= 2e-4, found
        assert np.median(most) <= 5e-6, found


@pytest.mark.parametrize("integrator", ["implicitfast", "Euler"])
def test_rollouts_of_muscles_stay_with_those_of_mujoco(integrator):
    model, worlds, steps = compile_model(ARM, integrator), 16, 50
    data = mujoco.MjData(model)
    for seed in range(3):
        q, v = starts(model, worlds, seed=seed)
        act = np.random.default_rng(seed).uniform(size=(worlds, model.na))
        states = np.hstack([np.zeros((worlds, 1)), q, v, act])
        u = controls(model, steps, worlds, seed=seed).transpose(1, 0, 2)
        with rollout.Rollout(fall_back=False) as own, mujoco.rollout.Rollout(nthread=0) as peer:
            found, expected = own.rollout(model, data, states, u)[0], peer.rollout(model, data, states, u)[0]
            near = states + 6e-8 * np.random.default_rng(seed).choice([-1.0, 1.0], states.shape)
            nudged = peer.rollout(model, data, near, u)[0]
        sensitive = np.abs(nudged - expected).max(axis=(1, 2))
        assert (np.abs(found - expected).max(axis=(1, 2)) <= 1e-4 + 100.0 * sensitive).all()


FREE = """<mujoco><option integrator="implicitfast" timestep="0.01"/><worldbody>
  <body><freejoint name="free"/><geom type="box" size="0.1 0.2 0.3" mass="2" pos="0.05 0 0.02"/></body></worldbody>
  <actuator><velocity joint="free" gear="{gear}" kv="{kv}"/></actuator></mujoco>"""


@pytest.mark.parametrize("gear", ["0 0 1 0 0 0", "0 0 0 0 1 0"])
@pytest.mark.parametrize(("kv", "damping"), [(20, (0,) * 6), (0, (6, 6, 6, 1, 2, 3)), (20, (1, 2, 3, 0, 0, 0))])
def test_a_free_body_is_damped_along_each_axis_as_in_mujoco(kv, damping, gear):
    """By a servo about one axis, and by dampings that differ between axes."""
    model = mujoco.MjModel.from_xml_string(FREE.format(gear=gear, kv=kv))
    model.dof_damping[:] = damping
    data = mujoco.MjData(model)
    data.qvel[:] = np.arange(1.0, 7.0)
    state = np.empty((1, mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    mujoco.mj_getState(model, data, state[0], mujoco.mjtState.mjSTATE_FULLPHYSICS)
    u = np.ones((1, 50, 1))
    with rollout.Rollout(fall_back=False) as own, mujoco.rollout.Rollout(nthread=0) as peer:
        found, expected = (one.rollout(model, data, state, u)[0] for one in (own, peer))
    np.testing.assert_allclose(found, expected, atol=1e-4)


@needs("g++")
@pytest.mark.parametrize("text", [ARM, TRANSMISSIONS], ids=["muscles", "transmissions"])
def test_lanes_of_a_warp_do_the_same(text, tmp_path_factory):
    model = compile_model(text)
    states = visited(model, 0, 2)
    start = states.q[:4], states.v[:4], np.repeat(states.control[None, :4], 3, axis=0), states.act[:4]
    found = LaneRollout(model, 4, 3, folder=tmp_path_factory.getbasetemp())(*start)
    for x, y in zip(found, PlainRollout(model, 4, 3, lanes=4)(*start), strict=True):
        np.testing.assert_allclose(x, y, atol=5e-5)


def _turned(model: mujoco.MjModel, seed: int):
    """States with ball joints turned anyhow, under controls of several turns."""
    q, v = starts(model, 8, seed=seed)
    for j in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_BALL):
        turns = np.random.default_rng(seed).normal(size=(8, 4))
        q[:, model.jnt_qposadr[j] :][:, :4] = turns / np.linalg.norm(turns, axis=1, keepdims=True)
    return visit([model], q, v, 4.0 * controls(model, 60, 8, seed=seed), every=4)


@pytest.mark.parametrize("integrator", ["implicitfast", "Euler"])
def test_transmissions_limits_armatures_and_carried_weights_are_those_of_mujoco(integrator):
    """Cranks, sites in frames of others, balls in their parents' frames, servos that go round; limits of tendons."""
    model = compile_model(TRANSMISSIONS, integrator)
    assert missing(model) is None
    for seed in range(2):
        for states in (visited(model, seed), _turned(model, seed)):
            found = public_differences(model, states)
            most = found.v.max(axis=1) / (1.0 + np.abs(states.next_v).max(axis=1))
            assert (most <= 5e-5 + 20.0 * states.edge).mean() > 0.99, found
            assert np.median(most) <= 5e-6, found


def test_a_weight_that_actuators_are_to_carry_falls_without_them():
    model = compile_model(TRANSMISSIONS)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    found = step_differences(model, visited(model, 0), lanes=4)
    assert found.v.max() <= 1e-4, found


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_drawn_shapes_bend_tendons_as_in_mujoco(seed):
    """Spheres and cylinders of drawn sizes and places, without a side, with one outside, and one inside."""
    model = compile_model(shapes(seed))
    q, v = starts(model, 16, seed=seed, speed=2.0)
    states = visit([model], q, v, controls(model, 40, 16), every=2)
    found = step_differences(model, states, lanes=4)
    most = found.v.max(axis=1)
    sane = states.edge < 1e-3  # a tendon that slips off a shape moves by a jump
    assert sane.mean() > 0.9
    assert (most[sane] <= 2e-4 * (1.0 + np.abs(states.next_v[sane]).max(axis=1))).mean() > 0.99, found
    assert np.median(most) <= 2e-5, found


def test_points_on_a_line_through_the_centre_inside_the_shape_and_on_each_other_bend_as_in_mujoco():
    model = compile_model(DEGENERATE)
    states = visit([model], model.qpos0[None], np.zeros((1, model.nv)), np.zeros((1, 1, model.nu)))
    found = step_differences(model, states, lanes=4)
    assert np.abs(states.next_v).max() > 1e-3
    assert found.v.max() <= 1e-5, found.v


def test_every_kind_is_read_or_refused_by_name():
    for kinds in KINDS:
        names = {name.split("_", 1)[1] for name in kinds.enum.__members__ if name.startswith("mj")}
        assert names == set(kinds.read.split()) | set(kinds.refused.split()), kinds.what


def test_unread_kinds_are_refused_in_a_line():
    told = {kinds.what: kinds for kinds in KINDS}
    for text in ("dynamics", "gains", "biases", "transmissions"):
        model, said = compile_model(ARM), f"{text} of actuators"
        getattr(model, told[said].array)[0] = 77
        assert list(lacking_kinds(model)) == [f"{said}: 77"]
        assert missing(model) == f"{said}: 77"
