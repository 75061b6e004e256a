# SPDX-License-Identifier: Apache-2.0
"""The MuJoCo engine against a plain loop over ``mj_step``: worlds, order, forces, resets and worlds that blow up."""

import os

import mujoco
import numpy as np
import pytest
from small_scenes import BOX, DISC, WALL, compiled, make_engine, make_scene, roll

from warpmpc.engine import mujoco as engine_module
from warpmpc.scene.model.mujoco_model import make_world
from warpmpc.scene.model.pairs import Pair, collision_pairs
from warpmpc.scene.model.properties import draw_properties

PAIRS = (Pair("base", "wall"), Pair("base", "box"), Pair("box", "ground"), Pair("box", "wall"))
RANDOM = {"box": {"mass": {"uniform": 0.3}, "friction": {"uniform": 0.3}, "size": {"normal": 0.01}}}


@pytest.fixture(scope="module")
def scene():
    """The disc touches the box already, and the box is not far from the wall."""
    return make_scene(object=[{**BOX, "position": (0.36, 0.0, 0.1)}], obstacle=[WALL], randomize=RANDOM)


@pytest.fixture(scope="module")
def layout(scene):
    return compiled(scene).layout


def controls(steps: int, worlds: int, *, seed: int = 0, scale: float = 1.0) -> np.ndarray:
    """Random controls that mostly push forward, ``[T, W, 3]``."""
    rng = np.random.default_rng(seed)
    return (scale * rng.uniform([0.2, -0.5, -1.0], [1.0, 0.5, 1.0], size=(steps, worlds, 3))).astype(np.float32)


def starts(layout, envs: int) -> tuple[np.ndarray, np.ndarray]:
    """A start for every environment, ``[E, nq]`` and ``[E, nv]``."""
    q, qd = (np.tile(a, (envs, 1)) for a in (layout.joint_q, layout.joint_qd))
    q[:, 1] += 0.05 * np.arange(envs)
    qd[:, 0] += 0.1 * np.arange(envs)
    return q, qd


def plain_loop(model, initial: np.ndarray, control: np.ndarray, substeps: int):
    """States and sensor values of every physics step of one world, ``[n, ...]``."""
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, initial, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    states, sensors = [], []
    for u in control:
        data.ctrl[:] = u
        for _ in range(substeps):
            mujoco.mj_step(model, data)
            state = np.empty_like(initial)
            mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
            states.append(state)
            sensors.append(data.sensordata.copy())
    return np.array(states), np.array(sensors)


@pytest.mark.parametrize(("substeps", "envs", "samples", "domains"), [(1, 1, 5, 1), (3, 2, 3, 2)])
def test_every_world_is_a_plain_loop_over_its_own_model(scene, layout, substeps, envs, samples, domains):
    steps, worlds = 8, envs * samples * domains
    properties = draw_properties(scene, layout, 5, seed=3)
    engine = make_engine(
        scene,
        envs=envs,
        samples=samples,
        domains=domains,
        horizon=steps,
        substeps=substeps,
        pairs=PAIRS,
        properties=properties,
    )
    q, qd = starts(layout, envs)
    control = controls(steps, worlds)
    out = roll(engine, control, q, qd)
    force = out.contact_force.numpy()
    assert not out.diverged.numpy().any()
    assert np.any(force[:, :, 1])  # the disc pushes the box
    nominal = mujoco.MjModel.from_xml_string(compiled(scene).mjcf).body("box").mass[0]
    for w in range(worlds):
        e, s, d = w // (samples * domains), w // domains % samples, w % domains
        model = engine.models[w]
        draw = d if domains > 1 else s
        assert model.body("box").mass[0] == pytest.approx(nominal * properties.mass[draw, 0])
        assert model.opt.timestep == pytest.approx(scene.timing.control_dt / substeps)
        # one slide, one slide, one hinge, one free joint: all at the same place in Newton and MuJoCo
        initial = np.concatenate([[0.0], q[e, :6], q[e, [9, 6, 7, 8]], qd[e]])
        states, sensors = plain_loop(model, initial.astype(np.float64), control[:, w], substeps)
        last = states[substeps - 1 :: substeps]
        np.testing.assert_allclose(out.joint_q.numpy()[1:, w, :6], last[:, 1:7], atol=1e-6)
        np.testing.assert_allclose(out.joint_q.numpy()[1:, w, 6:10], last[:, [8, 9, 10, 7]], atol=1e-6)
        np.testing.assert_allclose(out.joint_qd.numpy()[1:, w, :6], last[:, 11:17], atol=1e-5)
        mean = sensors.reshape(steps, substeps, len(PAIRS), 3).mean(axis=1)
        np.testing.assert_allclose(force[:, w], -mean, atol=1e-4)
        np.testing.assert_allclose(out.joint_q.numpy()[0, w], q[e], atol=0)


def test_nothing_of_an_earlier_plan_remains(scene, layout):
    engine = make_engine(scene, samples=6, horizon=10, pairs=PAIRS)
    q, qd = starts(layout, 1)
    control = controls(10, 6)
    first = [a.numpy().copy() for a in vars(roll(engine, control, q, qd)).values()]
    other = q.copy()
    other[0, 3:5] = [1.3, 0.1]  # hard against the wall
    roll(engine, -control, other, qd)
    second = [a.numpy() for a in vars(roll(engine, control, q, qd)).values()]
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_number_of_threads_changes_nothing(scene, layout):
    q, qd = starts(layout, 1)
    control = controls(10, 16)
    results = []
    for threads in (1, 3):
        engine = make_engine(scene, samples=16, horizon=10, pairs=PAIRS, threads=threads)
        results.append([a.numpy().copy() for a in vars(roll(engine, control, q, qd)).values()])
        engine.close()
    for a, b in zip(*results, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("first_bad", [0, 4, 7])
def test_a_world_that_blows_up_is_flagged_and_disturbs_nobody(scene, layout, first_bad, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    engine = make_engine(scene, samples=6, horizon=8, pairs=PAIRS)
    q, qd = starts(layout, 1)
    control = controls(8, 6)
    clean = [a.numpy().copy() for a in vars(roll(engine, control, q, qd)).values()]
    before = engine_module.warnings.count
    capfd.readouterr()
    poisoned = control.copy()
    poisoned[first_bad:, 2] = 1e30
    out = roll(engine, poisoned, q, qd)
    assert out.diverged.numpy().tolist() == [0, 0, 1, 0, 0, 0]
    for a, b in zip(clean, vars(out).values(), strict=True):
        b = b.numpy()
        axis = 0 if b.ndim == 1 else 1
        np.testing.assert_array_equal(np.delete(b, 2, axis), np.delete(a, 2, axis))
    assert engine_module.warnings.count > before
    assert engine_module.warnings.last
    assert capfd.readouterr() == ("", "")
    assert os.listdir(tmp_path) == []
    for a, b in zip(clean, vars(roll(engine, control, q, qd)).values(), strict=True):
        np.testing.assert_array_equal(a, b.numpy())


def test_a_world_that_blows_up_in_its_only_step_stays_where_it_was_and_is_flagged(scene, layout):
    engine = make_engine(scene, samples=3, horizon=1, substeps=1)
    q, qd = starts(layout, 1)
    control = controls(1, 3)
    control[0, 1] = 1e30
    out = roll(engine, control, q, qd)
    assert out.diverged.numpy().tolist() == [0, 1, 0]
    np.testing.assert_array_equal(out.joint_q.numpy()[1, 1], out.joint_q.numpy()[0, 1])


@pytest.mark.parametrize(("array", "value"), [("q", np.nan), ("q", np.inf), ("qd", np.nan), ("qd", 1e12)])
def test_a_bad_state_flags_its_environment_alone(scene, layout, array, value):
    engine = make_engine(scene, envs=2, samples=3, horizon=4)
    q, qd = starts(layout, 2)
    control = controls(4, 6)
    clean = roll(engine, control, q, qd).joint_q.numpy().copy()
    {"q": q, "qd": qd}[array][1, 4] = value
    out = roll(engine, control, q, qd)
    assert out.diverged.numpy().tolist() == [0, 0, 0, 1, 1, 1]
    np.testing.assert_array_equal(out.joint_q.numpy()[:, :3], clean[:, :3])


def test_a_resting_box_is_carried_by_the_floor():
    scene = make_scene(object=[{**BOX, "position": (3.0, 0.0, 0.1), "mass": 2.5}])
    layout = compiled(scene).layout
    pairs = (Pair("box", "ground"), Pair("ground", "box"), Pair("base", "box"))
    engine = make_engine(scene, horizon=50, pairs=pairs)
    force = roll(engine, np.zeros((50, 1, 3)), layout.joint_q, layout.joint_qd).contact_force.numpy()[-1, 0]
    weight = 2.5 * 9.81
    np.testing.assert_allclose(force, [[0, 0, weight], [0, 0, -weight], [0, 0, 0]], atol=0.01 * weight)


def test_a_saturated_servo_presses_with_its_effort_limit():
    """The disc drives against a wall it cannot move: the wall pushes back with all the force the drive has."""
    drive = {**DISC["drive"], "damping": 1000.0, "effort_limit": 40.0}
    scene = make_scene(robot=[{**DISC, "joint_q": (1.15, 0.0, 0.0), "drive": drive}], obstacle=[WALL])
    layout = compiled(scene).layout
    engine = make_engine(scene, horizon=40, substeps=4, pairs=(Pair("base", "wall"), Pair("wall", "base")))
    control = np.tile(np.array([1.0, 0.0, 0.0]), (40, 1, 1))
    out = roll(engine, control, layout.joint_q, layout.joint_qd)
    force = out.contact_force.numpy()[-1, 0]
    np.testing.assert_allclose(force, [[-40.0, 0.0, 0.0], [40.0, 0.0, 0.0]], atol=0.4)
    assert out.joint_q.numpy()[-1, 0, 0] < 1.21  # it stopped at the wall
    assert abs(out.joint_qd.numpy()[-1, 0, 0]) < 1e-2


@pytest.mark.parametrize("keys", [{}, {"mode": "position", "stiffness": 4000.0}], ids=["velocity", "position"])
def test_a_saturated_servo_damps_long_steps(keys):
    """Whatever MuJoCo is installed: without it long steps go to and fro, and rollouts far from the plant's."""
    drive = {**DISC["drive"], "damping": 600.0, "effort_limit": 40.0, **keys}
    world = make_world(compiled(make_scene(robot=[{**DISC, "drive": drive}])), timestep=0.02)
    data, mass = mujoco.MjData(world.model), np.zeros((world.model.nv,) * 2)
    data.ctrl[:] = world.actuator_matrix @ [1.0, 0.0, 0.0] + world.actuator_offset
    mujoco.mj_step(world.model, data)
    mujoco.mj_fullM(world.model, data, mass)
    np.testing.assert_allclose(data.qvel[0], 0.02 * 40.0 / (mass[0, 0] + 0.02 * 600.0), rtol=1e-6)


def test_many_bodies_are_not_solved_by_a_wrong_sparse_factor():
    """Which MuJoCo 4.0.0 has, from 60 degrees of freedom on."""
    boxes = [{**BOX, "name": f"box_{i}", "position": (i, 2.0, 0.1)} for i in range(12)]
    model = make_world(compiled(make_scene(object=boxes)), timestep=0.02).model
    assert model.nv > 60
    assert mujoco.mj_isSparse(model) == (mujoco.__version__ != "4.0.0")


def test_the_whole_robot_counts_not_its_first_link():
    """Contacts of the last link are contacts of the robot, whose first link touches nothing."""
    scene = make_scene(robot=[{**DISC, "joint_q": (1.25, 0.0, 0.0)}], obstacle=[WALL])
    layout = compiled(scene).layout
    assert collision_pairs(layout) == (Pair("base", "wall"),)
    engine = make_engine(scene, horizon=2, pairs=collision_pairs(layout))
    force = roll(engine, np.zeros((2, 1, 3)), layout.joint_q, layout.joint_qd).contact_force.numpy()
    assert force[0, 0, 0, 0] < -1.0


def test_too_few_draws_are_refused(scene, layout):
    with pytest.raises(ValueError, match="4 draws"):
        make_engine(scene, samples=4, properties=draw_properties(scene, layout, 3, seed=0))
