# SPDX-License-Identifier: Apache-2.0
"""Sensors of a plant, and the estimated state in place of what they measure."""

import numpy as np
import pytest
from small_scenes import make_scene

from warpmpc import Plant, SceneError, load_scene
from warpmpc.loop.plant.simulated import SimulatedPlant
from warpmpc.loop.robots.simulated import RobotProcess
from warpmpc.scene.schema import EstimateBase

PUSH = np.array([0.6, 0.0, 0.0], dtype=np.float32)
BOX = {"name": "box", "shape": "box", "size": (0.2, 0.2, 0.2), "mass": 1.0, "position": (0.6, 0.0, 0.1)}
EXACT = {"rate": 30.0}
NOISY = {"rate": 30.0, "noise": {"position": 0.01, "rotation": 0.03}}
NOISE = {"noise": {"position": 0.01, "rotation": 0.03}}


def pushed(sensor, *, estimate=None, **plant):
    sections = {"estimate": {"box": estimate}} if estimate is not None else {}
    plant = {"randomize": False, "sensor": {"pose": {"box": sensor}}, **plant}
    return make_scene(object=[BOX], plant=plant, **sections)


def box_of(state):
    return state.joint_q[-7:], state.joint_qd[-6:]


def run(plant, steps=60):
    """True and observed states of the box, step by step, as rows (position, quaternion, velocities)."""
    rows = []
    for _ in range(steps):
        plant.apply(PUSH)
        seen, true = plant.observe(), plant.state
        rows.append([np.concatenate(box_of(seen)), np.concatenate(box_of(true))])
    return np.array(rows).swapaxes(0, 1)


def test_measurements_come_at_their_rate_and_late():
    plant = Plant(pushed({**EXACT, "delay": 0.1}))
    known = []
    for _ in range(50):
        plant.apply(PUSH)
        known += [(plant.time, m.time) for m in plant.measurements()]
    now, measured = np.transpose(known)
    physics = plant.model.opt.timestep
    np.testing.assert_allclose(measured, np.arange(len(measured)) / 30.0, atol=physics)
    assert (now - measured >= 0.1 - 1e-5).all()
    assert (now - measured <= 0.1 + plant.scene.timing.control_dt + 1e-5).all()


def test_an_exact_sensor_shows_what_is_there():
    plant = Plant(pushed({"rate": 25.0}))
    seen, true = run(plant)
    np.testing.assert_allclose(seen[:, :7], true[:, :7], atol=1e-6)
    assert true[-1, 0] > BOX["position"][0] + 0.1  # it was pushed


def test_noise_bias_and_dropouts_are_as_the_scene_says():
    sensor = {**NOISY, "rate": 200.0, "bias": {"position": 0.5}, "dropouts": 0.3}
    scene = pushed(sensor)
    plant, again = Plant(scene, seed=4), Plant(scene, seed=4)
    rows = []
    for _ in range(100):
        plant.apply(np.zeros(plant.layout.nu))
        rows += [m.pose for m in plant.measurements()]
    rows, due = np.array(rows), 200 * plant.time + 1
    assert len(rows) == pytest.approx(0.7 * due, rel=0.1)
    assert rows[:, 0].std() == pytest.approx(0.01, rel=0.1)
    assert 2.0 * rows[:, 3].std() == pytest.approx(0.03, rel=0.1)
    assert np.linalg.norm(rows[:, :3].mean(axis=0) - box_of(plant.state)[0][:3]) > 0.1  # one of 0.5 m, drawn once
    np.testing.assert_array_equal(again.measurements()[0].pose, rows[0])
    plant.reset()
    np.testing.assert_array_equal(plant.measurements()[0].pose, rows[0])


@pytest.mark.parametrize("seed", range(3))
def test_an_estimate_is_nearer_than_the_last_measurement(seed):
    keys = {"process": {"linear": 0.5, "angular": 2.0}, **NOISE}
    raw, filtered = (run(Plant(pushed(NOISY, estimate=estimate), seed=seed)) for estimate in (None, keys))
    np.testing.assert_array_equal(raw[1], filtered[1])  # the same run
    errors = [np.sqrt(np.mean((seen - true) ** 2, axis=0)) for seen, true in (raw, filtered)]
    assert errors[1][:3].mean() < 0.8 * errors[0][:3].mean()
    assert errors[1][7:10].mean() < 0.5 * errors[0][7:10].mean()
    assert errors[1][10:].mean() < 0.5 * errors[0][10:].mean()


def test_a_batch_sees_what_its_plants_would_see_alone():
    scene = pushed(NOISY, estimate=NOISE)
    batch, alone = Plant(scene, envs=2, seed=5), Plant(scene, seed=6)
    for _ in range(5):
        batch.apply(np.tile(PUSH, (2, 1)))
        alone.apply(PUSH)
        np.testing.assert_array_equal(batch.observe().joint_q[1], alone.observe().joint_q)


def test_before_the_first_measurement_it_is_at_its_start():
    plant = Plant(pushed({**EXACT, "delay": 0.2}, estimate=NOISE))
    run(plant, steps=2)
    np.testing.assert_array_equal(box_of(plant.observe())[0], plant.layout.joint_q[-7:])


def test_what_nothing_measures_is_not_estimated():
    scene = make_scene(object=[BOX], estimate={"box": NOISE})
    for make in (Plant, lambda scene: RobotProcess(scene, None)):
        with pytest.raises(SceneError, match=r"add \[plant.sensor.pose.box\]") as caught:
            make(scene)
        assert caught.value.key == "estimate.box"
    scene = load_scene("quadruped_walk").model_copy(
        update={"estimate_base": {"dog": EstimateBase(feet=["dog/fr_foot"])}}
    )
    with pytest.raises(SceneError, match=r"add \[plant.sensor.imu.dog\]"):
        Plant(scene)


@pytest.mark.parametrize("section", ["estimate", "plant.sensor.pose"])
def test_what_is_not_free_is_told_with_its_key(section):
    keys = {"estimate": {"base": NOISE}} if section == "estimate" else {"plant": {"sensor": {"pose": {"base": EXACT}}}}
    with pytest.raises(SceneError, match="free root") as caught:
        SimulatedPlant(make_scene(object=[BOX], **keys))
    assert caught.value.key == f"{section}.base"
    assert "box" in str(caught.value)
