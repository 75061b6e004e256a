# SPDX-License-Identifier: Apache-2.0
"""``check`` tells how near samples come to what success asks."""

import numpy as np
import pytest
from planted import ARM, SCENE

from warpmpc import Controller, Plant, load_scene
from warpmpc.extras.doctor.control import plan_findings, term_costs
from warpmpc.extras.doctor.places import approaches, probes, still_findings
from warpmpc.scene.model.at_start import Subject


def planned(folder, scene: str, asset: str):
    """Controller and plant of a scene of which one plan was made."""
    (folder / "scene.toml").write_text(scene)
    (folder / "arm.xml").write_text(asset)
    controller = Controller(load_scene(folder / "scene.toml"), engine="mujoco", device="cpu")
    plant = Plant(controller.scene, task=controller.task)
    controller.step(plant.observe())
    return controller, plant


def test_samples_come_nearer_to_what_a_robot_does_and_not_to_what_it_has_not_touched_yet(tmp_path):
    success = '[success]\nposition = 0.05\nconditions = { joint = "arm/elbow", above = 1.0 }\n\n[[cost]]'
    controller, plant = planned(tmp_path, SCENE.replace("[[cost]]", success, 1), ARM)
    before = plant.monitor.progress
    found = {item.start.name: item for item in approaches(probes(controller), plant.monitor)}
    assert plant.monitor.progress == before
    elbow, box = found["arm/elbow"], found["error along x [m]"]
    assert elbow.nearer
    assert (elbow.start.value, elbow.start.bound) == (0.0, 1.0)
    assert elbow.best.value > 0.0
    assert not box.nearer
    assert box.best.value == pytest.approx(0.3, abs=1e-3)
    assert not list(still_findings(Subject(controller.scene, controller.compiled), probes(controller)))


def test_each_of_two_bounds_of_one_number_has_its_own_nearest_sample(tmp_path):
    success = '[success]\nconditions = { frame = "arm/fore", above = 9.0, below = -9.0 }\n\n[[cost]]'
    controller, plant = planned(tmp_path, SCENE.replace("[[cost]]", success, 1), ARM)
    rollouts = probes(controller)
    heights = np.array([rollout.body_q[:, 1, 2] for rollout in rollouts])
    highest, lowest = approaches(rollouts, plant.monitor)
    assert (highest.best.above, lowest.best.above) == (True, False)
    assert highest.best.value == pytest.approx(heights.max())
    assert lowest.best.value == pytest.approx(heights.min())


def test_terms_of_all_samples_are_compared_or_of_many_and_the_best(tmp_path, monkeypatch):
    controller, _ = planned(tmp_path, SCENE, ARM)
    assert len(term_costs(controller)) == controller.shape.samples
    monkeypatch.setattr("warpmpc.extras.doctor.control.COMPARED", 2)
    assert term_costs(controller).sum(axis=1).min() == pytest.approx(controller.engine.cost.numpy().min())


def test_samples_that_all_diverged_are_a_finding(tmp_path):
    controller, _ = planned(tmp_path, SCENE, ARM)
    controller.engine.cost.fill_(np.inf)
    assert term_costs(controller).shape == (0, 2)
    (finding,) = plan_findings(Subject(controller.scene, controller.compiled), controller)
    assert "diverged" in str(finding)
