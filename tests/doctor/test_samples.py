# SPDX-License-Identifier: Apache-2.0
"""``check`` tells which pairs of bodies take the time of contacts, and how near samples come to what success asks."""

import re

import numpy as np
import pytest
from planted import ARM, LEGS, SCENE

from warpmpc.controller.controller import Controller
from warpmpc.doctor.approach import approaches, probes, still_findings
from warpmpc.doctor.contact_time import contact_time
from warpmpc.doctor.control import plan_findings, term_costs
from warpmpc.doctor.subject import Subject
from warpmpc.plant.plant import Plant
from warpmpc.scene.load import load_scene

MESH = '<asset><mesh name="m" vertex="{}"/></asset><worldbody>'.format(
    " ".join(f"{x} {y} {z}" for x in (-0.04, 0.04) for y in (-0.04, 0.04) for z in (-0.48, 0.0))
)


def planned(folder, scene: str, asset: str):
    """Controller and plant of a scene of which one plan was made."""
    (folder / "scene.toml").write_text(scene)
    (folder / "arm.xml").write_text(asset)
    controller = Controller(load_scene(folder / "scene.toml"), engine="mujoco", device="cpu")
    plant = Plant(controller.scene, task=controller.task)
    controller.step(plant.observe())
    return controller, plant


@pytest.mark.parametrize("meshes", [2, 4])
def test_pairs_and_meshes_that_take_the_time_of_contacts_are_named(tmp_path, meshes):
    leg = '<geom type="capsule" fromto="0 0 0 0 0 -.46" size=".04" mass=".5"/>'
    mesh = '<geom type="mesh" mesh="m" mass=".5"/>' * (meshes // 2)
    asset = LEGS.replace(leg, mesh).replace("<worldbody>", MESH)
    controller, _ = planned(tmp_path, SCENE.replace("arm/fore", "arm/left"), asset)
    text = contact_time(Subject(controller.scene, controller.compiled), probes(controller))
    assert re.match(r"\d+% of a physics step of \d+ µs in MuJoCo; \d shapes collide, ", text)
    assert f"{meshes} of them meshes; most for " in text
    assert "arm/left and ground" in text
    assert (f"links with the {meshes} meshes of arm take" in text) == (meshes >= 4)


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


def test_samples_that_all_diverged_are_a_finding(tmp_path):
    controller, _ = planned(tmp_path, SCENE, ARM)
    controller.engine.cost.fill_(np.inf)
    assert term_costs(controller).shape == (0, 2)
    (finding,) = plan_findings(Subject(controller.scene, controller.compiled), controller)
    assert "diverged" in str(finding)
