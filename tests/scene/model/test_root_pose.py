# SPDX-License-Identifier: Apache-2.0
"""``position`` and ``rotation`` of a robot replace the root pose of its file."""

import mujoco
import numpy as np
import pytest
from native_robots import native_scene

from warpmpc.scene.model.compiled import compile_scene

WALKER = """
<mujoco><worldbody>
  <geom name="floor" type="plane" size="5 5 .1"/>
  <geom name="wall" type="box" size=".1 1 1" pos="3 0 1"/>
  <body name="table" pos="2 0 0.4"><geom type="box" size=".2 .2 .02"/></body>
  <body name="trunk" pos="0 0 0.445" quat="0 0 0 1"><freejoint name="root"/><geom type="box" size=".2 .1 .05" mass="5"/>
    <body name="leg" pos="0.1 0 0"><joint name="knee" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02"/>
    </body></body>
</worldbody><actuator><motor joint="knee" ctrlrange="-1 1"/></actuator>
<keyframe><key name="low" qpos="0.5 0 0.2 1 0 0 0 0.3"/></keyframe></mujoco>
"""
TURN = (0.0, 0.0, np.sin(0.4), np.cos(0.4))


@pytest.fixture
def walker(tmp_path):
    path = tmp_path / "walker.xml"
    path.write_text(WALKER)
    return path


def start(path, **keys):
    """The compiled scene's start: pose of the trunk, and MuJoCo's data there."""
    compiled = compile_scene(native_scene(path, **keys), cache=False)
    model = compiled.spec().compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return compiled.layout, data


def test_without_a_pose_the_root_is_where_its_file_has_it(walker):
    layout, data = start(walker)
    np.testing.assert_allclose(layout.joint_q[:7], [0.0, 0.0, 0.445, 0.0, 0.0, 1.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(data.body("r/trunk").xpos, [0.0, 0.0, 0.445], atol=1e-9)
    np.testing.assert_allclose(data.geom("r/wall").xpos, [3.0, 0.0, 1.0], atol=1e-9)


def test_a_position_replaces_the_roots_own_and_keeps_its_rotation(walker):
    layout, data = start(walker, position=(1.0, 2.0, 0.3))
    np.testing.assert_allclose(layout.joint_q[:7], [1.0, 2.0, 0.3, 0.0, 0.0, 1.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(data.body("r/trunk").xpos, [1.0, 2.0, 0.3], atol=1e-6)


def test_a_rotation_replaces_the_roots_own_and_keeps_its_position(walker):
    layout, data = start(walker, rotation=TURN)
    np.testing.assert_allclose(layout.joint_q[:7], [0.0, 0.0, 0.445, *TURN], atol=1e-6)
    np.testing.assert_allclose(data.body("r/trunk").xquat, [TURN[3], *TURN[:3]], atol=1e-6)


def test_all_else_in_the_file_moves_along_but_its_floors(walker):
    before, after = start(walker)[1], start(walker, position=(1.0, 2.0, 0.3), rotation=TURN)[1]
    for data in (before, after):
        at, turned = data.body("r/trunk").xpos, data.body("r/trunk").xmat.reshape(3, 3)
        places = [turned.T @ (x - at) for x in (data.body("r/table").xpos, data.geom("r/wall").xpos)]
        if data is before:
            expected = places
    np.testing.assert_allclose(places, expected, atol=1e-6)
    np.testing.assert_allclose(after.geom("r/floor").xpos, 0.0, atol=1e-9)


def test_a_keyframes_root_is_replaced_as_well_and_its_joints_are_not(walker):
    layout, _ = start(walker, keyframe="low", position=(1.0, 2.0, 0.3))
    np.testing.assert_allclose(layout.joint_q, [1.0, 2.0, 0.3, 0.0, 0.0, 0.0, 1.0, 0.3], atol=1e-6)
    layout, _ = start(walker, keyframe="low")
    np.testing.assert_allclose(layout.joint_q, [0.5, 0.0, 0.2, 0.0, 0.0, 0.0, 1.0, 0.3], atol=1e-6)


def test_the_place_of_a_robot_comes_back_from_the_cache(walker, tmp_path, monkeypatch):
    monkeypatch.setenv("WARPMPC_CACHE", str(tmp_path / "cache"))
    scene = native_scene(walker, position=(1.0, 2.0, 0.3))
    first, second = compile_scene(scene), compile_scene(scene)
    assert first is not second
    assert first.mjcf_robots == second.mjcf_robots
    assert first.mjcf_robots[0].place[2] == pytest.approx(0.3 - 0.445)
