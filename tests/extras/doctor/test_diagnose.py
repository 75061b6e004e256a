# SPDX-License-Identifier: Apache-2.0
"""Planted causes of wrong predictions: each is named with its cure; of a sound run nothing is found."""

import functools

import numpy as np
import pytest

from warpmpc import RunRecorder, load_scene
from warpmpc.extras.doctor.diagnose import diagnose
from warpmpc.extras.doctor.foresight import logged_steps
from warpmpc.extras.record.replay import logged_scene
from warpmpc.loop.run.episode import Episode
from warpmpc.scene.model.compiled import compile_scene

SHORT = ["planner.samples=32", "planner.refine=false", "timing.timeout=1.2"]


@functools.cache
def run(name: str, *overrides: str, engine: str = "mujoco"):
    """Log and result of a short run."""
    scene = load_scene(name, overrides=[*SHORT, *overrides])
    episode = Episode(scene, seed=0, engine=engine, device="cpu")
    recorder = RunRecorder(episode.plant, episode.controller)
    result = episode.run(recorder=recorder)
    return recorder.run_log, result


def diagnosed(log):
    """Diagnosis of a logged run."""
    scene = logged_scene(log)
    found, left_out = diagnose(log, scene, compile_scene(scene))
    assert left_out == []
    return found


@pytest.mark.parametrize(
    ("name", "engine"),
    [("cartpole_swingup", "mujoco"), ("quadrotor", "fused"), ("omni_push_box", "mujoco")],
)
def test_a_sound_run_has_no_cause(name, engine):
    log, result = run(name, engine=engine)
    found = diagnosed(log)
    assert found.cause is None
    assert found.sentence.startswith("nothing found")
    assert result.foresight["state_ahead"] == pytest.approx(found.error, rel=1e-3, abs=1e-4)
    assert result.foresight["state_ahead"] < 0.1


@pytest.mark.parametrize(
    ("name", "planted", "cause", "cure"),
    [
        ("cartpole_swingup", ["plant.factor.cart.mass=2"], "masses, friction and sizes", "plant.factor"),
        ("cartpole_swingup", ["plant.delay=0.08"], "without delay", "plant.delay"),
        (
            "cartpole_swingup",
            ["plant.noise.position=0.03", "plant.noise.velocity=0.5"],
            "without noise",
            "plant.noise",
        ),
        ("quadrotor", ["plant.noise.position=0.02", "plant.noise.velocity=0.3"], "without noise", "plant.noise"),
        (
            "cartpole_swingup",
            ["engine.substeps=1", "planner.dt=0.1", "planner.horizon=15"],
            "physics steps of",
            "engine.substeps",
        ),
    ],
)
def test_a_planted_cause_is_named_with_its_cure(name, planted, cause, cure):
    log, result = run(name, *planted)
    found = diagnosed(log)
    assert found.cause is not None, found
    assert cause in found.cause.cause, found
    assert cure in found.sentence
    assert result.foresight["state_ahead"] > 0.1


def test_the_plants_physics_leads_from_the_logged_states_to_those_that_came():
    log, _ = run("cartpole_swingup", "plant.delay=0.08", "plant.noise.velocity=0.2")
    last = diagnosed(log).trials[-1]
    assert last.after < 1e-4 < last.before


def test_observations_know_which_state_they_are_of():
    log, _ = run("cartpole_swingup", "plant.delay=0.06")
    seen = logged_steps(log, logged_scene(log)).seen
    np.testing.assert_array_equal(seen, np.maximum(np.arange(len(seen)) - 3, 0))


def test_a_verdict_tells_of_predictions_that_are_wrong():
    _, result = run("cartpole_swingup", "plant.delay=0.08")
    assert not result.success
    assert [s for s in result.verdict if "predictions are wrong" in s and "warpmpc diagnose" in s]
    assert result.to_json()["foresight"]["cost"] == result.foresight["cost"]
    _, sound = run("cartpole_swingup", "timing.timeout=0.4")
    assert not sound.success
    assert not [s for s in sound.verdict if "predictions are wrong" in s]


def test_without_physics_nothing_is_foreseen():
    scene = load_scene("storm_reach", overrides=["timing.timeout=0.1", "planner.samples=64"])
    assert Episode(scene, seed=0).run().foresight == {}
