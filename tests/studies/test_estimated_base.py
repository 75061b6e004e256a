# SPDX-License-Identifier: Apache-2.0
"""Errors of an estimated base along a run, and the states that a scene with one is run with."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from shared.base_errors import BaseErrors
from studies.estimated import BASES, FILTERS, SCENES, Run, rows, run

import warpmpc
from warpmpc.run.records import Records


class Joint:
    q, qd = slice(0, 7), slice(0, 6)


def state(place, rotation, velocity):
    """A state of nothing but a base."""
    return warpmpc.State(np.r_[place, Rotation.from_euler("zyx", rotation).as_quat()], np.r_[velocity, np.zeros(3)])


def test_tilt_yaw_velocity_and_drift_are_told_apart():
    errors = BaseErrors(Joint())
    for k in range(5):
        true = state([0.5 * k, 0.0, 0.3], [0.2, 0.0, 0.0], [np.cos(0.2), np.sin(0.2), 0.0])
        # the same velocity along its own axes, but for 0.1 m/s upwards
        seen = state([0.55 * k, 0.0, 0.3], [0.3, 0.0, 0.0], [np.cos(0.3), np.sin(0.3), 0.1])
        errors.note(seen, true)
    found = errors.result()
    assert found["tilt"] == pytest.approx(0.0, abs=1e-6)
    assert found["yaw"] == pytest.approx(0.1)
    assert found["velocity"] == pytest.approx(0.1)
    assert (found["way"], found["drift"]) == pytest.approx((2.0, 0.2))
    errors = BaseErrors(Joint())
    errors.note(
        state([0.0, 0.0, 0.3], [0.5, 0.0, 0.04], np.zeros(3)), state([0.0, 0.0, 0.3], [0.5, 0.0, 0.0], np.zeros(3))
    )
    assert errors.result()["tilt"] == pytest.approx(0.04)
    assert "10.0 % (to 10.0) of the way" in BaseErrors.text([found])


def test_true_states_are_neither_measured_nor_late():
    for task in BASES:
        true, estimated = (Run(task=task, strategy=kind, overrides=(), seed=0).scene for kind in ("true", "estimated"))
        assert not (true.estimate_base)
        assert not (true.plant.sensor.imu)
        assert not (true.plant.delay)
        assert estimated.estimate_base
        assert estimated.plant.sensor.imu
        assert estimated.plant.delay == 0.02
        others = {"plant": true.plant, "estimate_base": {}}
        assert estimated.model_copy(update=others) == true


def test_a_measured_scene_is_run_with_both_filters_and_has_one_of_them():
    for task in SCENES:
        own = warpmpc.load_scene(task).estimate
        runs = [Run(task=task, strategy=model.value, overrides=(), seed=0).scene.estimate for model in FILTERS]
        assert [{part.model for part in found.values()} for found in runs] == [{model} for model in FILTERS]
        assert own in runs


def test_the_table_has_what_was_seen_of_a_base(tmp_path):
    record = {"success": True, "reason": "goal reached", "time": 10.0, "reached": None}
    record |= {"tilt": 0.01, "velocity": 0.02, "drift": 0.1, "yaw": 0.05, "way": 5.0}
    records = Records(tmp_path / "estimated.jsonl")
    job = Run(task=BASES[0], strategy="estimated", overrides=(), seed=0)
    records.add(job.key(run.__name__), record)
    ((*_, reached, _, error, _),) = rows([job], records)
    assert reached == "1 of 1"
    assert "tilt 0.57°, 2.0 cm/s" in error
    assert "2.0 % (to 2.0) of the way, yaw 2.9°" in error
