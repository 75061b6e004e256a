# SPDX-License-Identifier: Apache-2.0
"""Planted mistakes: each is found, at its key, with its cure, and a scene without one has no finding."""

import pytest
from needs import need_scene

from warpmpc.controller.controller import Controller
from warpmpc.doctor.contacts import contact_findings
from warpmpc.doctor.control import plan_findings, reach_findings
from warpmpc.doctor.joints import joint_findings
from warpmpc.doctor.subject import Subject
from warpmpc.model.compiled import compile_scene
from warpmpc.plant.plant import Plant
from warpmpc.scene.load import load_scene

ARM = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0" range="-1.5 1.5" damping="1"/>
      <geom name="upper" type="capsule" fromto="0 0 0 0 0 -.4" size=".05" mass="1" contype="1" conaffinity="1"/>
      <body name="fore" pos="0 0 -.5">
        <joint name="elbow" axis="0 1 0" range="-2 2" damping="1"/>
        <geom name="fore" type="capsule" fromto="0 0 0 .4 0 0" size=".04" mass=".5" contype="1" conaffinity="1"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="shoulder" joint="shoulder" kp="100" ctrlrange="-1.5 1.5" forcerange="-40 40"/>
    <position name="elbow" joint="elbow" kp="50" ctrlrange="-2 2" forcerange="-20 20"/>
  </actuator>
</mujoco>
"""
LEGS = """
<mujoco>
  <worldbody>
    <body name="torso" pos="0 0 .5">
      %s
      <geom type="box" size=".1 .1 .05" mass="3"/>
      <body name="left" pos="0 .15 0"><joint name="left" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.46" size=".04" mass=".5"/></body>
      <body name="right" pos="0 -.15 0"><joint name="right" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.46" size=".04" mass=".5"/></body>
    </body>
  </worldbody>
  <actuator><motor joint="left" ctrlrange="-9 9"/><motor joint="right" ctrlrange="-9 9"/></actuator>
</mujoco>
"""
HAND = """
<mujoco>
  <worldbody>
    <body name="lead" mocap="true" pos="0 0 1"/>
    <body name="hand" pos="0 0 1"><freejoint/><geom type="box" size=".05 .05 .05" mass="1"/></body>
    <body name="slider" pos="3 0 1"><joint name="slide" type="slide"/>
      <geom type="box" size=".05 .05 .05" mass="1" contype="0" conaffinity="0"/></body>
  </worldbody>
  <equality><weld body1="lead" body2="hand"/></equality>
  <actuator><motor joint="slide" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
SCENE = """
timing = { control_dt = 0.02, timeout = 2.0 }

[[robot]]
name = "arm"
asset = "arm.xml"

[[object]]
name = "box"
shape = "box"
size = [0.1, 0.1, 0.1]
mass = 0.5
position = [0.6, 0.0, 0.05]

[[obstacle]]
name = "post"
shape = "box"
size = [0.1, 0.1, 0.6]
position = [1.0, 0.5, 0.3]

[goal]
object = "box"
position = [0.9, 0.0]

[[cost]]
term = "distance"
between = ["box", "goal"]

[[cost]]
term = "distance"
name = "near"
between = ["arm/fore", "box"]

[planner]
samples = 16
horizon = 20

[planner.noise]
sigma = { range = 0.2 }
"""


def scene_of(folder, *, arm=(), scene=(), asset=ARM):
    """The scene above with some of its text, and of its robot's, replaced."""
    text = SCENE
    for old, new in arm:
        assert old in asset
        asset = asset.replace(old, new)
    for old, new in scene:
        assert old in text
        text = text.replace(old, new)
    (folder / "arm.xml").write_text(asset)
    (folder / "scene.toml").write_text(text)
    return load_scene(folder / "scene.toml")


def still(scene):
    """Findings that need no plan."""
    subject = Subject(scene, compile_scene(scene, cache=False))
    return [*joint_findings(subject), *contact_findings(subject), *reach_findings(subject)]


def planned(scene):
    """Findings about a plan."""
    controller = Controller(scene, engine="mujoco", device="cpu")
    controller.step(Plant(scene, seed=1).observe())
    return list(plan_findings(controller))


def test_a_scene_without_mistakes_has_no_finding(tmp_path):
    scene = scene_of(tmp_path)
    assert still(scene) == []
    assert planned(scene) == []


@pytest.mark.parametrize(
    ("key", "text", "cure", "arm", "scene"),
    [
        (
            "robot.arm",
            "from -1.5° to 1.5°",
            'angle="radian"',
            [
                ('<compiler angle="radian"/>', ""),
            ],
            [],
        ),
        (
            "robot.arm",
            "from -90 to 90 rad",
            'angle="degree"',
            [('range="-1.5 1.5" damping', 'range="-90 90" damping'), ('ctrlrange="-1.5 1.5"', "")],
            [],
        ),
        (
            "robot.arm.joint_q",
            "arm/elbow starts at 30, outside its range of -2 to 2: is it in degrees?",
            "joint_q",
            [],
            [('asset = "arm.xml"', 'asset = "arm.xml"\njoint_q = { elbow = 30.0 }')],
        ),
        (
            "robot.arm.asset",
            "is one of them in degrees?",
            "ctrlrange",
            [('ctrlrange="-2 2"', 'ctrlrange="-115 115"')],
            [],
        ),
        ("robot.arm.asset", "wrong sign", "positive", [('kp="50"', 'kp="-50"')], []),
        (
            "robot.arm.asset",
            "negative damping",
            "positive",
            [('range="-2 2" damping="1"', 'range="-2 2" damping="-1"')],
            [],
        ),
        ("robot.arm.drive", "to hold the start against gravity", "kilograms", [('mass=".5"', 'mass="50"')], []),
        ("object.box", "more than any metal", "kilograms", [], [("mass = 0.5", "mass = 500.0")]),
        ("object.box.friction", "no friction", "rubber", [], [("mass = 0.5", "mass = 0.5\nfriction = 0.0")]),
        ("goal.position", "inside the obstacle post", "move", [], [("[0.9, 0.0]", "[1.0, 0.5]")]),
        (
            "goal.position",
            "inside the obstacle post",
            "move",
            [],
            [('object = "box"\nposition = [0.9, 0.0]', 'frame = "arm/fore"\nposition = [1.0, 0.5, 0.3]')],
        ),
        (
            "object.box",
            "no robot can touch box",
            "collision shapes",
            [('contype="1" conaffinity="1"', 'contype="0" conaffinity="0"')],
            [],
        ),
        (
            "cost.distance",
            "no control can move box",
            "drive",
            [('contype="1" conaffinity="1"', 'contype="0" conaffinity="0"')],
            [],
        ),
    ],
)
def test_a_mistake_is_found_with_its_cure(tmp_path, key, text, cure, arm, scene):
    findings = still(scene_of(tmp_path, arm=arm, scene=scene))
    assert [f for f in findings if f.key == key and text in f.text and cure in f.cure], findings


@pytest.mark.parametrize(("root", "found"), [("", True), ("<freejoint/>", False)])
def test_legs_whose_root_is_welded_to_the_world_are_found(tmp_path, root, found):
    findings = still(scene_of(tmp_path, asset=LEGS % root))
    assert [f.key for f in findings if "2 legs stand" in f.text] == ["robot.arm.floating"] * found


def test_a_hand_that_a_mocap_body_leads_is_found(tmp_path):
    scene = scene_of(tmp_path, asset=HAND, scene=[('["box", "goal"]', '["arm/hand", "goal"]')])
    found = [f for f in still(scene) if f.key == "cost.distance"]
    assert len(found) == 1
    assert "no control can move arm/hand: a mocap body leads it" in found[0].text
    assert found[0].cure.endswith('robot.arm.drive = { mode = "mocap", body = "lead", limit = 0.5 }')
    driven = ('asset = "arm.xml"', 'asset = "arm.xml"\ndrive = { mode = "mocap", limit = 0.5 }')
    scene = scene_of(tmp_path, asset=HAND, scene=[('["box", "goal"]', '["arm/hand", "goal"]'), driven])
    assert not [f for f in still(scene) if f.key == "cost.distance"]


@pytest.mark.parametrize(
    ("key", "text", "scene"),
    [
        ("planner.lookahead", "0.04 s ahead", [("horizon = 20", "horizon = 2")]),
        (
            "cost.distance.weight",
            "rewards a large distance",
            [('between = ["box", "goal"]', 'between = ["box", "goal"]\nweight = -1.0')],
        ),
        ("cost", "cost the same", [('["arm/fore", "box"]', '["post", "box"]')]),
    ],
)
def test_a_mistake_of_plans_is_found(tmp_path, key, text, scene):
    findings = planned(scene_of(tmp_path, scene=scene))
    assert [f for f in findings if f.key == key and text in f.text], findings


@pytest.mark.parametrize("name", ["omni_push_box", "panda_reach", "quadruped_walk", "pendulum", "hand_cube"])
def test_shipped_scenes_have_no_finding(name):
    need_scene(name)
    assert still(load_scene(name)) == []
