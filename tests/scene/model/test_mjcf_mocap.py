# SPDX-License-Identifier: Apache-2.0
"""A drive that moves a mocap body: the hand that is welded to it follows, as fast as is commanded and not faster."""

import numpy as np
import pytest

from warpmpc import Controller, Plant, SceneError, load_scene

ARM = """
<mujoco>
  <option gravity="0 0 -9.81"/>
  <default><default class="heavy"><joint damping="3" armature="0.1"/></default></default>
  <worldbody>
    <body name="lead" mocap="true"><geom size=".02" contype="0" conaffinity="0"/></body>
    %s
    <body name="upper" pos="0 0 1" childclass="heavy"><joint name="shoulder" axis="0 0 1"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="2"/>
      <body name="fore" pos=".4 0 0"><joint name="elbow" axis="0 0 1"/>
        <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="1"/>
        <body name="lift" pos=".4 0 0"><joint name="lift" type="slide" axis="0 0 1"/><geom size=".02" mass=".5"/>
          <body name="hand"><joint name="wrist" axis="0 0 1"/><geom type="box" size=".02 .02 .02" mass=".3"/>
            <body name="finger" pos=".05 0 0"><joint name="grip" type="slide" axis="0 1 0" range="0 .04"/>
              <geom size=".01" mass=".05"/></body></body></body></body></body>
    <body name="ball" pos="3 0 1"><freejoint name="ball"/><geom size=".05" mass=".1"/></body>
  </worldbody>
  <equality><weld body1="lead" body2="hand"/></equality>
  <actuator><position name="grip" joint="grip" kp="100" ctrlrange="0 .04"/></actuator>
  <keyframe><key name="bent" qpos="0.5 1 0 0 .02 2 0 1 1 0 0 0" ctrl=".03"/></keyframe>
</mujoco>
"""
"""An arm whose hand only a mocap body can move, with a finger that has an actuator."""

SCENE = """
ground = false
[timing]
control_dt = 0.02
timeout = 2.0
[[robot]]
name = "arm"
asset = "arm.xml"
joint_q = { shoulder = 0.5, elbow = 1.0 }
drive = { mode = "mocap", limit = [0.5, 0.5, 0.2] }
[goal]
frame = "arm/hand"
position = [0.2, 0.5, 1.1]
[[cost]]
term = "distance"
between = ["arm/hand", "goal"]
[planner]
samples = 16
horizon = 25
dt = 0.02
"""


def scene_of(folder, *changes, second=""):
    text = SCENE
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "arm.xml").write_text(ARM % second)
    (folder / "scene.toml").write_text(text)
    return load_scene(folder / "scene.toml")


def drive(text):
    return ('drive = { mode = "mocap", limit = [0.5, 0.5, 0.2] }', text)


def pose_of(plant, name):
    return plant.body_q[plant.layout.frame_body[plant.layout.frame_name.index(name)]].copy()


def moved(plant, steps=50, **speeds):
    """Movement of the hand and of the mocap body [m], and the hand's pose, after commands at rest and some steps."""
    command = np.zeros(plant.layout.nu)
    for _ in range(50):
        plant.apply(command)
    for name, speed in speeds.items():
        command[plant.layout.control_name.index(f"arm/{name}")] = speed
    before = pose_of(plant, "arm/hand"), pose_of(plant, "arm/lead")
    for _ in range(steps):
        plant.apply(command)
    return pose_of(plant, "arm/hand")[:3] - before[0][:3], pose_of(plant, "arm/lead")[:3] - before[1][:3]


def test_the_hand_starts_at_rest_and_follows_the_commanded_speed_in_the_plant(tmp_path):
    plant = Plant(scene_of(tmp_path))
    np.testing.assert_allclose(pose_of(plant, "arm/lead"), pose_of(plant, "arm/hand"), atol=1e-6)
    assert plant.layout.nm == 0
    hand, lead = moved(plant, lead_x=-0.3, lead_y=-0.2, lead_z=0.1)
    np.testing.assert_allclose(lead, [-0.3, -0.2, 0.1], atol=0.005)  # a lag of 10 ms
    np.testing.assert_allclose(hand, lead, atol=0.01)


def test_it_stays_in_the_box_that_it_is_given(tmp_path):
    box = "[[0.2, 0.4, 0.9], [0.6, 0.7, 1.1]]"
    plant = Plant(scene_of(tmp_path, drive(f'drive = {{ mode = "mocap", limit = 0.5, within = {box} }}')))
    moved(plant, lead_x=-0.5, lead_z=0.5)
    np.testing.assert_allclose(pose_of(plant, "arm/lead")[[0, 2]], [0.2, 1.1], atol=0.02)
    hand, _ = moved(plant, steps=10, lead_x=0.3, lead_z=-0.3)  # there is nothing to undo before it comes back
    np.testing.assert_allclose(hand[[0, 2]], [0.06, -0.06], atol=0.02)


@pytest.mark.parametrize("engine", ["fused", "mujoco"])
def test_plans_foresee_it_and_keep_the_limit(tmp_path, engine):
    sigma = ("horizon = 25", "horizon = 25\nnoise.sigma = 5.0")
    controller = Controller(scene_of(tmp_path, sigma), engine=engine)
    controller.step(Plant(controller.scene).observe())
    names = controller.layout.control_name
    columns = [names.index(f"arm/lead_{axis}") for axis in "xyz"]
    for sample in range(0, 16, 5):
        rollout = controller.rollout(sample)
        hand, lead = (rollout.frame(f"arm/{name}")[:, :3] for name in ("hand", "lead"))
        assert (np.abs(np.diff(lead, axis=0)) < np.array([0.5, 0.5, 0.2]) * 0.0201).all()
        way = np.cumsum(rollout.control[:, columns] * 0.02, axis=0)
        np.testing.assert_allclose(lead[1:] - lead[0], way, atol=0.015)
        np.testing.assert_allclose(hand - hand[0], lead - lead[0], atol=0.02)


@pytest.mark.parametrize(("rotation", "count"), [("yaw", 1), ("all", 3)])
def test_rotations_are_controls_where_they_are_asked_for(tmp_path, rotation, count):
    plant = Plant(scene_of(tmp_path, drive(f'drive = {{ mode = "mocap", limit = 0.5, rotation = "{rotation}" }}')))
    assert plant.layout.nu == 4 + count
    before = pose_of(plant, "arm/hand")
    hand, _ = moved(plant, lead_turn_z=0.4)
    yaw = [2.0 * np.arctan2(q[5], q[6]) for q in (before, pose_of(plant, "arm/hand"))]
    assert yaw[1] - yaw[0] == pytest.approx(0.4, abs=0.03)
    np.testing.assert_allclose(hand, 0.0, atol=0.01)


def test_the_files_actuators_stay_beside_it_and_other_drives_replace_them(tmp_path):
    layout = Plant(scene_of(tmp_path)).layout
    assert layout.control_name == ("arm/grip", "arm/lead_x", "arm/lead_y", "arm/lead_z")
    np.testing.assert_allclose(layout.control_upper, [0.04, 0.5, 0.5, 0.2])
    grip = '{ mode = "position", joints = ["grip"], stiffness = 100, damping = 1 }'
    layout = Plant(scene_of(tmp_path, drive(f'drive = [{{ mode = "mocap", limit = 0.5 }}, {grip}]'))).layout
    assert layout.control_name == ("arm/lead_x", "arm/lead_y", "arm/lead_z", "arm/grip")
    np.testing.assert_allclose(layout.control_upper, [0.5, 0.5, 0.5, 0.04])


def test_in_a_keyframe_the_mocap_body_stands_at_the_hand(tmp_path):
    start = "joint_q = { shoulder = 0.5, elbow = 1.0 }"
    plant = Plant(scene_of(tmp_path, (start, 'keyframe = "bent"')))
    np.testing.assert_allclose(pose_of(plant, "arm/lead"), pose_of(plant, "arm/hand"), atol=1e-6)
    assert plant.layout.control_start[0] == pytest.approx(0.03)
    plant = Plant(scene_of(tmp_path, (start, "joint_q = { shoulder = -0.5 }")))
    key = plant.layout.keyframes[0]
    names = list(plant.layout.dof_name)
    offset = [key.joint_q[names.index(f"arm/lead_{axis}")] for axis in "xyz"]
    there = 0.4 * np.array([np.cos(0.5) + np.cos(1.5), np.sin(0.5) + np.sin(1.5)])
    here = 0.8 * np.array([np.cos(0.5), -np.sin(0.5)])
    np.testing.assert_allclose(offset, [*(there - here), 0.0], atol=1e-6)


def test_a_mocap_body_that_no_drive_moves_stays_one(tmp_path):
    second = '<body name="other" mocap="true" pos="0 0 2"/>'
    named = drive('drive = { mode = "mocap", body = "lead", limit = 0.5 }')
    assert Plant(scene_of(tmp_path, named, second=second)).layout.mocap_name == ("arm/other",)


def test_the_robots_place_is_that_of_its_root_and_not_of_the_mocap_body(tmp_path):
    plant = Plant(scene_of(tmp_path, ('asset = "arm.xml"', 'asset = "arm.xml"\nposition = [1, 0, 2]')))
    np.testing.assert_allclose(pose_of(plant, "arm/upper")[:3], [1.0, 0.0, 2.0], atol=1e-6)
    np.testing.assert_allclose(pose_of(plant, "arm/lead"), pose_of(plant, "arm/hand"), atol=1e-6)


def test_a_free_body_of_the_file_starts_where_joint_q_puts_it(tmp_path):
    given = ("joint_q = { shoulder = 0.5, elbow = 1.0 }", "joint_q = { ball = [1, 2, 3] }")
    np.testing.assert_allclose(pose_of(Plant(scene_of(tmp_path, given)), "arm/ball"), [1, 2, 3, 0, 0, 0, 1])
    turned = (given[0], "joint_q = { ball = [1, 2, 3, 0, 0, 2, 0] }")
    np.testing.assert_allclose(pose_of(Plant(scene_of(tmp_path, turned)), "arm/ball"), [1, 2, 3, 0, 0, 1, 0])
    for wrong, key, says in (
        ("{ ball = [1, 2] }", "joint_q.ball", r"needs \[x, y, z\]"),
        ("{ elbow = [1, 2] }", "joint_q.elbow", "needs one number"),
        ("{ bal = [1, 2, 3] }", "joint_q", "Did you mean 'ball'"),
    ):
        with pytest.raises(SceneError, match=rf"robot\.arm\.{key}: .*{says}"):
            Plant(scene_of(tmp_path, (given[0], f"joint_q = {wrong}")))


OTHER = '<body name="other" mocap="true"/>'


@pytest.mark.parametrize(
    ("text", "second", "message"),
    [
        ('{ mode = "mocap" }', "", r"drive: mode 'mocap' needs limit"),
        ('{ mode = "mocap", limit = 1, joints = ["elbow"] }', "", "drive: .*leave joints out"),
        ('{ mode = "velocity", damping = 1, limit = 1, body = "lead" }', "", "drive: .*belong to mode 'mocap'"),
        ('{ mode = "mocap", limit = 1, within = [[0, 0, 0], [1, 0, 1]] }', "", "drive: within is .lowest corner"),
        ('{ mode = "mocap", limit = [1, 2] }', "", "drive.limit: needs 1 or 3 values"),
        ('{ mode = "mocap", limit = 1, rotation = "roll" }', "", "drive.rotation: no such choice"),
        ('{ mode = "mocap", limit = 1, body = "led" }', "", "drive.body: .*no such mocap body; .*Did you mean 'lead'"),
        ('{ mode = "mocap", limit = 1 }', OTHER, "drive.body: name one of .*lead, other"),
        (
            '[{ mode = "mocap", limit = 1, body = "lead" }, { mode = "mocap", limit = 1, body = "lead" }]',
            OTHER,
            r"drive\.1\.body: this mocap body has two drives; found 'lead'",
        ),
    ],
)
def test_mistakes_are_named_with_key_and_cure(tmp_path, text, second, message):
    with pytest.raises(SceneError, match=rf"robot\.arm\.{message}"):
        Plant(scene_of(tmp_path, drive(f"drive = {text}"), second=second))


def test_a_file_without_a_mocap_body_and_one_that_is_no_mjcf_are_refused(tmp_path):
    (tmp_path / "bare.xml").write_text(
        '<mujoco><worldbody><body name="hand"><joint/><geom size=".1"/></body></worldbody></mujoco>'
    )
    asset = ('asset = "arm.xml"\njoint_q = { shoulder = 0.5, elbow = 1.0 }', 'asset = "bare.xml"')
    with pytest.raises(SceneError, match=r"robot\.arm\.drive: .*this file has none: take mode 'velocity'"):
        Plant(scene_of(tmp_path, asset))
    (tmp_path / "arm.urdf").write_text('<robot name="arm"><link name="hand"/></robot>')
    asset = ('asset = "arm.xml"\njoint_q = { shoulder = 0.5, elbow = 1.0 }', 'asset = "arm.urdf"')
    with pytest.raises(SceneError, match=r"robot\.arm\.drive\.mode: a URDF file has no mocap bodies"):
        Plant(scene_of(tmp_path, asset))


def test_the_engine_without_physics_refuses_hands_that_it_would_leave_behind(tmp_path):
    with pytest.raises(SceneError, match=r"robot\.arm\.drive\.mode: the engine kinematic has no welds"):
        Controller(scene_of(tmp_path), engine="kinematic")
