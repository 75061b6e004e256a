# SPDX-License-Identifier: Apache-2.0
"""``BatchSimulator`` against MuJoCo, world by world: states, poses, readings, forces, their own numbers."""

import copy

import mujoco
import numpy as np
import pytest
import warp as wp
from needs import CUDA, needs

from warpmpc.physics import BatchSimulator
from warpmpc.physics.simulator import NUMBERS

TEXT = """
<mujoco>
  <option timestep="0.005" iterations="100" tolerance="0"/>
  <worldbody>
    <geom name="floor" type="plane" size="4 4 .1" friction=".6"/>
    <body name="base" pos="-.6 0 .15">
      <joint name="x" type="slide" axis="1 0 0" damping="1"/><joint name="turn" axis="0 0 1" damping=".2"/>
      <geom name="stick" type="capsule" size=".05" fromto="0 0 0 .3 0 0" mass="1"/>
      <site name="end" pos=".3 0 0"/>
    </body>
    <body name="box" pos="0 0 .1">
      <freejoint/><geom name="box" type="box" size=".1 .08 .1" mass=".7" friction=".5"/>
    </body>
    <body name="still" pos="1 1 0" euler="0 0 90"><geom size=".1" contype="0" conaffinity="0"/></body>
  </worldbody>
  <actuator><position joint="x" kp="60" kv="5"/><general joint="turn" dyntype="filter" dynprm=".02"/></actuator>
  <sensor>
    <framepos objtype="geom" objname="box"/><framelinvel objtype="site" objname="end"/>
    <jointpos joint="x"/>
  </sensor>
</mujoco>
"""
WORLDS = 19


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(TEXT)


def starts(model, seed=0):
    """States in which boxes stand and sticks are beside them or about to touch them."""
    rng = np.random.default_rng(seed)
    qpos = np.repeat(model.qpos0[None], WORLDS, axis=0)
    qpos[:, :2] += rng.uniform(-0.1, 0.1, (WORLDS, 2))
    qvel = np.zeros((WORLDS, model.nv))
    qvel[:, 0] = rng.uniform(0.0, 1.0, WORLDS)
    return qpos, qvel, rng.uniform(-1.0, 1.0, (WORLDS, model.nu))


def of_mujoco(models, qpos, qvel, ctrl, n, worlds=None):
    """MuJoCo's data of every world after n steps, or n more, and the mean force on the first of base and box."""
    out, force = [], np.zeros((WORLDS, 3))
    for w in range(WORLDS):
        m = models[w]
        data = mujoco.MjData(m) if worlds is None else worlds[w]
        if worlds is None:
            data.qpos[:], data.qvel[:], data.ctrl[:] = qpos[w], qvel[w], ctrl[w]
        for _ in range(n):
            mujoco.mj_step(m, data)
            for c, contact in enumerate(data.contact):
                bodies = m.geom_bodyid[contact.geom]
                if set(bodies) == {m.body("base").id, m.body("box").id}:
                    wrench = np.zeros(6)
                    mujoco.mj_contactForce(m, data, c, wrench)
                    sign = 1.0 if bodies[1] == m.body("base").id else -1.0
                    force[w] += sign * contact.frame.reshape(3, 3).T @ wrench[:3] / n
        mujoco.mj_forward(m, data)
        out.append(data)
    return out, force


def test_worlds_are_those_of_mujoco(model):
    qpos, qvel, ctrl = starts(model)
    sim = BatchSimulator(model, WORLDS, threads=2, contact_pairs=[("base", "box")])
    sim.reset(qpos=qpos, qvel=qvel)
    np.testing.assert_allclose(sim.qpos, qpos, atol=1e-6)
    data = None
    for _ in range(12):
        sim.step(ctrl, 5)
        data, _ = of_mujoco([model] * WORLDS, qpos, qvel, ctrl, 5, data)
        np.testing.assert_allclose(sim.qpos, [d.qpos for d in data], atol=2e-4)
        np.testing.assert_allclose(sim.act, [d.act for d in data], atol=1e-5)
        np.testing.assert_allclose(sim.xpos, [d.xpos for d in data], atol=2e-4)
        np.testing.assert_allclose(sim.xquat, [d.xquat for d in data], atol=2e-4)
        np.testing.assert_allclose(sim.sensordata, [d.sensordata for d in data], atol=5e-3)
        np.testing.assert_allclose(sim.time, data[0].time, atol=1e-9)
    assert np.ptp(sim.qpos[:, 2]) > 0.01  # some boxes were pushed
    assert not (sim.diverged | sim.overflow).any()


def test_contact_forces_are_those_on_the_first_body(model):
    qpos, qvel, ctrl = starts(model)
    qpos[:, 0] += 0.25  # the sticks push the boxes on
    ctrl[:, 0], ctrl[:, 1] = 0.9, 0.0
    forces = []
    for pair in (("base", "box"), ("box", "base")):
        sim = BatchSimulator(model, WORLDS, contact_pairs=[pair])
        sim.reset(qpos=qpos, qvel=qvel)
        sim.step(ctrl, 30)
        at, speed = sim.qpos.copy(), sim.qvel.copy()
        sim.step(n=10)
        forces.append(sim.contact_force[:, 0].copy())
    _, expected = of_mujoco([model] * WORLDS, at, speed, ctrl, 10)
    assert (abs(expected[:, 0]) > 1.0).sum() > WORLDS // 2
    np.testing.assert_allclose(forces[0], expected, atol=0.15)
    np.testing.assert_array_equal(forces[1], -forces[0])
    kept, some = sim.contact_force.copy(), np.arange(WORLDS) % 2 == 0
    sim.reset(some)
    np.testing.assert_array_equal(sim.contact_force[~some], kept[~some])
    assert not sim.contact_force[some].any()


def test_views_are_the_memory_that_worlds_move_in(model):
    sim = BatchSimulator(model, WORLDS)
    qpos, xpos = sim.qpos, sim.xpos
    assert all(np.shares_memory(a, b) for a, b in ((qpos, sim.qpos), (xpos, sim.xpos), (sim.qvel, sim.qvel)))
    sim.step(np.ones(model.nu), 40)
    assert qpos[0, 0] > model.qpos0[0] + 0.01
    qpos[:, 0] = -0.9
    sim.forward()
    np.testing.assert_allclose(xpos[:, model.body("base").id, 0], -0.6 - 0.9, atol=1e-6)
    np.testing.assert_allclose(np.from_dlpack(sim.sensordata)[:, -1], -0.9, atol=1e-6)


def test_a_reset_of_some_worlds_leaves_the_others(model):
    qpos, qvel, ctrl = starts(model)
    sim = BatchSimulator(model, WORLDS)
    sim.reset(qpos=qpos, qvel=qvel)
    sim.step(ctrl, 20)
    before, mask = sim.qpos.copy(), np.arange(WORLDS) % 3 == 0
    sim.reset(mask, qpos=qpos)
    np.testing.assert_array_equal(sim.qpos[~mask], before[~mask])
    np.testing.assert_allclose(sim.qpos[mask], qpos[mask], atol=1e-6)
    assert not np.hstack([sim.qvel[mask], sim.time[mask, None]]).any()
    assert sim.time[~mask].all()
    sim.reset(mask, qpos=qpos[mask][:, :] + 0.0, qvel=qvel[0])
    np.testing.assert_allclose(sim.qvel[mask], np.repeat(qvel[:1], mask.sum(), axis=0), atol=1e-6)


def test_the_same_start_gives_the_same_bits_on_any_number_of_threads(model):
    qpos, qvel, ctrl = starts(model)
    ends = []
    for threads in (1, 2, 2):
        sim = BatchSimulator(model, WORLDS, threads=threads)
        for _ in range(2):
            sim.reset(qpos=qpos, qvel=qvel)
            for _ in range(20):
                sim.step(ctrl, 3)
            ends.append(sim.qpos.copy())
    assert all(np.array_equal(end, ends[0]) for end in ends)


@pytest.mark.parametrize("worlds_alike", [True, False])
def test_worlds_have_numbers_of_their_own(model, worlds_alike):
    qpos, qvel, ctrl = starts(model)
    vary = NUMBERS
    sim = BatchSimulator(model, WORLDS, vary=vary)
    rng = np.random.default_rng(1)
    scale = np.repeat(
        rng.uniform(0.5, 2.0, (1 if worlds_alike else WORLDS, len(vary))), WORLDS if worlds_alike else 1, 0
    )
    models = []
    for w in range(WORLDS):
        own = copy.copy(model)
        own.body_mass[:] *= scale[w, 0]
        own.body_inertia[:] *= scale[w, 0]
        own.geom_friction[:, 0] *= scale[w, 2]
        own.geom_size[1] *= scale[w, 3]
        own.actuator_gainprm[0, 0] *= scale[w, 4]
        own.actuator_biasprm[0, 1] *= scale[w, 4]
        own.opt.gravity[2] *= scale[w, 6]
        models.append(own)
    sim.set_numbers(
        **{n: [m.opt.gravity if n == "gravity" else getattr(m, n) for m in models] for n in vary},
    )
    for own in models:
        mujoco.mj_setConst(own, mujoco.MjData(own))
        own.geom_rbound[1] = own.geom_size[1, :2].sum()
        own.geom_aabb[1, 3:] = 1.0  # nobody may be missed by MuJoCo's broad phase
    sim.reset(qpos=qpos, qvel=qvel)
    sim.step(ctrl, 40)
    data, _ = of_mujoco(models, qpos, qvel, ctrl, 40)
    expected = np.array([d.qpos for d in data])
    assert np.median(abs(sim.qpos - expected).max(axis=1)) < 1e-4
    assert abs(sim.qpos - expected).max() < 5e-3
    plain, _ = of_mujoco([model] * WORLDS, qpos, qvel, ctrl, 40)
    assert abs(expected - [d.qpos for d in plain]).max() > 0.01


def test_numbers_may_become_zero_and_back(model):
    sim = BatchSimulator(model, 3, vary=("gravity", "actuator_gainprm"))
    sim.set_numbers(gravity=np.zeros(3), actuator_gainprm=np.zeros_like(model.actuator_gainprm))
    sim.step(np.ones(model.nu), n=20)
    assert abs(sim.qvel[:, 4]).max() < 1e-4  # nothing falls or is driven
    sim.set_numbers(gravity=[0.0, 0.0, 3.0])
    sim.step(n=20)
    assert (sim.qvel[:, 4] > 0.2).all()


def test_one_world_has_numbers_of_its_own(model):
    sim = BatchSimulator(model, 1, vary=("gravity",))
    sim.set_numbers(gravity=[0.0, 0.0, 3.0])
    sim.step(n=20)
    assert sim.qpos[0, 4] > 0.11


@pytest.mark.parametrize(
    ("act", "match"),
    [
        (lambda m: BatchSimulator(m, 3, vary=("mass",)), "vary has mass; there is: body_mass"),
        (lambda m: BatchSimulator(m, 3).set_numbers(body_mass=m.body_mass), "name it in vary"),
        (lambda m: BatchSimulator(m, 3).reset(qpos=np.zeros(2)), r"qpos has the shape \(2,\)"),
        (lambda m: BatchSimulator(m, 3).reset(mask=[True]), "mask has the shape"),
        (lambda m: BatchSimulator(m, 3, contact_pairs=[("base", "bux")]), "bux"),
        (lambda m: BatchSimulator(m, 3).step(np.zeros((3, 5))), r"ctrl has the shape \(3, 5\), not \(3, 2\)"),
        (lambda m: BatchSimulator(m, 3).step(n=-1), "n is -1"),
        (lambda m: BatchSimulator(m, 3).step(n=2**31), "n is 2147483648"),
        (lambda m: BatchSimulator(m, 0), "worlds is 0"),
        (lambda m: BatchSimulator(m, 3).step(wp.zeros((3, 2), dtype=int)), r"ctrl is a wp.array of shape \(3, 2\)"),
        (lambda m: BatchSimulator(m, 3).step(wp.zeros((3, 1), dtype=float)), r"wp.array of shape \(3, 1\)"),
        (lambda m: BatchSimulator(m, 3).step(wp.zeros(2, dtype=float)), r"wp.array of shape \(2,\)"),
        (lambda m: BatchSimulator(m, 3, vary=("body_mass",)).set_numbers(body_mass=m.body_mass + 1e300), "beyond 1e"),
        (lambda m: BatchSimulator(m, 3, vary=("body_mass",)).set_numbers(body_mass=-m.body_mass), "negative"),
        (lambda m: BatchSimulator(m, 3, vary=("gravity",)).set_numbers(gravity=[0, 0, np.nan]), "no numbers"),
        (lambda m: BatchSimulator(m, 3, vary=("gravity",)).set_numbers(gravity=np.zeros(2)), "shape"),
    ],
)
def test_errors_say_what_to_do(model, act, match):
    with pytest.raises((ValueError, KeyError), match=match):
        act(model)


def test_a_callback_is_an_error(model):
    sim = BatchSimulator(model, 3)
    mujoco.set_mjcb_passive(lambda m, d: None)
    try:
        with pytest.raises(ValueError, match="mjcb_passive"):
            sim.step()
    finally:
        mujoco.set_mjcb_passive(None)
    sim.step()


def test_numbers_that_were_zero_cannot_be_set(model):
    own = copy.copy(model)
    own.actuator_gainprm[:] = 0.0
    sim = BatchSimulator(own, 3, vary=("actuator_gainprm",))
    with pytest.raises(ValueError, match="zero"):
        sim.set_numbers(actuator_gainprm=model.actuator_gainprm)
    np.testing.assert_array_equal(sim.numbers("actuator_gainprm"), 0.0)
    sim.step(n=2)


def test_what_it_lacks_is_an_error():
    own = mujoco.MjModel.from_xml_string(TEXT.replace("<sensor>", '<sensor><user dim="1"/>'))
    with pytest.raises(ValueError, match="user"):
        BatchSimulator(own, 3)
    own = mujoco.MjModel.from_xml_string(TEXT)
    own.opt.noslip_iterations = 3
    with pytest.raises(ValueError, match="noslip"):
        BatchSimulator(own, 3)


@needs(CUDA)
@pytest.mark.gpu
@needs(CUDA)
def test_worlds_on_a_gpu_are_those_on_a_cpu(model):
    qpos, qvel, ctrl = starts(model)
    found = []
    for device in ("cpu", "cuda:0"):
        sim = BatchSimulator(model, WORLDS, device=device, contact_pairs=[("base", "box")])
        sim.reset(qpos=qpos, qvel=qvel)
        for _ in range(6):
            sim.step(ctrl, 5)
        arrays = (sim.qpos, sim.qvel, sim.xpos, sim.xquat, sim.sensordata, sim.contact_force, sim.time)
        found.append([np.array(x if device == "cpu" else x.numpy()) for x in arrays])
    for a, b in zip(*found, strict=True):
        np.testing.assert_allclose(b, a, atol=5e-3)


@needs(CUDA)
@pytest.mark.gpu
@needs(CUDA)
def test_torch_sees_the_memory_of_a_gpu(model):
    torch = pytest.importorskip("torch")
    sim = BatchSimulator(model, 64, device="cuda:0", vary=("body_mass", "gravity"))
    qpos = torch.from_dlpack(sim.qpos)
    qpos[:, 0] = 0.25
    torch.cuda.synchronize()
    sim.set_numbers(gravity=np.zeros(3))
    sim.step(n=1)
    assert abs(float(qpos[:, 0].mean()) - 0.25) < 0.05
