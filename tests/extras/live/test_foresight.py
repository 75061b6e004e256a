# SPDX-License-Identifier: Apache-2.0
"""What the planner predicted beside what came, while a run goes on: as after it, and wrong models show."""

import numpy as np
import pytest

from warpmpc import RunRecorder, load_scene
from warpmpc.engine.registry import make_engine
from warpmpc.extras.doctor import foresight
from warpmpc.extras.doctor.foresight import foresee, logged_steps
from warpmpc.extras.live.foresight import ForesightMeter
from warpmpc.loop.run.episode import Episode
from warpmpc.scene.model.compiled import compile_scene

STEPS = 30


def played(name, *overrides, steps=STEPS, engine="fused"):
    """Comparisons after every control of a run ``[n]``, its meter, and its recorder."""
    scene = load_scene(name, overrides=["planner.samples=32", "engine.threads=1", *overrides])
    episode = Episode(scene, seed=0, engine=engine, device="cpu")
    controller, plant = episode.controller, episode.plant
    recorder, meter, found = RunRecorder(plant, controller), ForesightMeter(controller, plant), []
    for _ in range(steps):
        control = controller.step(plant.observe())
        meter.note(control)
        plant.apply(control)
        recorder.log(control)
        found.append(meter.compare())
    return found, meter, recorder


@pytest.mark.parametrize("name", ["cylinder_push", "quadrotor", "humanoid_stand"])
def test_with_the_same_model_what_came_is_what_was_foreseen(name):
    found, *_ = played(name, "plant.randomize=false", "planner.randomize=false")
    seen = [one for one in found if one is not None]
    assert len(seen) > STEPS // 2
    assert seen[-1].error < 0.05
    np.testing.assert_allclose([one.cost for one in seen], [one.came for one in seen], rtol=0.02)


@pytest.mark.parametrize("planted", ["plant.factor.quadrotor.mass=2", "plant.delay=0.08", "plant.noise.velocity=0.5"])
def test_a_wrong_model_shows_as_it_does_after_the_run(planted):
    found, _, recorder = played("quadrotor", planted, "plant.randomize=false", steps=60)
    scene, log = load_scene("quadrotor", overrides=[planted, "plant.randomize=false"]), recorder.run_log
    after = foresee(scene, compile_scene(scene), logged_steps(log, scene), seed=0, engine="fused")
    assert found[-1].error > 0.1
    assert found[-1].error == pytest.approx(after.ahead, rel=0.3)
    assert found[-1].cost != pytest.approx(found[-1].came, rel=1e-4)


def test_controls_before_a_gap_foresee_nothing():
    found, meter, _ = played("cylinder_push")
    assert found[-1] is not None
    meter.forget()
    assert meter.compare() is None


def test_an_engine_without_physics_foresees_nothing():
    found, meter, _ = played("storm_reach", "planner.samples=64", steps=3, engine="kinematic")
    assert not meter.known
    assert found == [None] * 3


def test_the_engine_that_planned_foresees(monkeypatch):
    made = []
    monkeypatch.setattr(foresight, "make_engine", lambda name, request: made.append(name) or make_engine(name, request))
    _, _, recorder = played("quadrotor", "plant.randomize=false")
    scene, log = load_scene("quadrotor"), recorder.run_log
    assert foresee(scene, compile_scene(scene), logged_steps(log, scene), seed=0, engine="fused").ahead < 0.05
    assert made == ["fused", "mujoco"]  # what was foreseen, what came
