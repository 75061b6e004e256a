# SPDX-License-Identifier: Apache-2.0
"""No false alarms: shipped scenes and models of packages have no finding that is not true of them."""

import pytest
from needs import need_scene
from package_models import KNOWN, package_models

from warpmpc import Controller, Plant
from warpmpc.doctor.advice import advise
from warpmpc.doctor.examine import examine, examine_model
from warpmpc.doctor.subject import Subject
from warpmpc.model.compiled import compile_scene
from warpmpc.scene.load import load_scene, shipped_scenes

FAST = ("omni_push_box", "panda_reach", "pendulum", "quadrotor", "quadruped_walk", "walker")


@pytest.mark.parametrize(
    "name", [name if name in FAST else pytest.param(name, marks=pytest.mark.slow) for name in shipped_scenes()]
)
def test_shipped_scenes_have_no_finding(name):
    need_scene(name)
    scene = load_scene(name)
    controller = Controller(scene, device="cpu")
    plant = Plant(scene, task=controller.task, seed=1)
    controller.step(plant.observe())
    assert [*advise(scene, controller.compiled), *map(str, examine(controller, plant.monitor))] == []


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_models_of_packages_have_no_finding_but_those_that_are_true():
    found = {
        (name, str(finding))
        for name, scene in package_models().items()
        for finding in examine_model(Subject(scene, compile_scene(scene, cache=False)))
    }
    unknown = [
        (name, sentence)
        for name, sentence in found
        if not any(text in sentence and any(part in name for part in parts) for text, parts in KNOWN)
    ]
    assert unknown == []
