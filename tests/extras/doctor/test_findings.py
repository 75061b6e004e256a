# SPDX-License-Identifier: Apache-2.0
"""No false alarms: shipped scenes and models of packages have no finding that is not true of them.

Slow ones by hand: pytest -m slow tests/extras/doctor/test_findings.py
"""

import mujoco
import numpy as np
import pytest
from needs import need_scene
from package_models import KNOWN, package_models

from warpmpc import Controller, Plant, load_scene, shipped_scenes
from warpmpc.extras.doctor.advice import advise
from warpmpc.extras.doctor.examine import examine, examine_model
from warpmpc.extras.doctor.places import reach
from warpmpc.scene.model.at_start import Subject
from warpmpc.scene.model.compiled import compile_scene

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


def test_no_posture_takes_a_hand_out_of_its_reach():
    scene = load_scene("panda_reach")
    subject = Subject(scene, compile_scene(scene))
    model, layout, (centre, radius) = subject.world.model, subject.compiled.layout, reach(subject, "panda/hand")
    index = layout.frame_name.index("panda/hand")
    body = model.body(subject.compiled.body_name[layout.frame_body[index]]).id
    rng, data, farthest = np.random.default_rng(0), mujoco.MjData(model), 0.0
    for _ in range(300):
        data.qpos[:] = rng.uniform(-3.0, 3.0, model.nq)
        mujoco.mj_kinematics(model, data)
        at = data.xpos[body] + data.xmat[body].reshape(3, 3) @ layout.frame_pose[index, :3]
        farthest = max(farthest, float(np.linalg.norm(at - centre)))
    assert 0.6 * radius < farthest < radius
