# SPDX-License-Identifier: Apache-2.0
"""The compile cache knows every file an asset is read from."""

import pytest
from native_robots import native_scene
from needs import need_scene

from warpmpc import load_scene, shipped_scenes
from warpmpc.scene.load import shipped_folder
from warpmpc.scene.model.assets import asset_files
from warpmpc.scene.model.compiled import _cache_key

ROBOT = """
<mujoco><compiler meshdir="meshes" texturedir="pictures"/>
  <include file="parts/assets.xml"/>
  <worldbody><include file="parts/body.xml"/></worldbody>
  <actuator><motor joint="turn" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
ASSETS = """
<mujoco><asset><mesh name="part" file="part.obj"/><texture name="t" type="2d" file="t.png"/></asset></mujoco>
"""
BODY = """
<mujocoinclude><body name="arm"><joint name="turn"/><geom type="mesh" mesh="part"/></body></mujocoinclude>
"""
MESH = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.fixture
def robot(tmp_path):
    files = {
        "robot.xml": ROBOT,
        "parts/assets.xml": ASSETS,
        "parts/body.xml": BODY,
        "meshes/part.obj": MESH,
        "pictures/t.png": "not a picture",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def test_all_files_of_an_mjcf_robot_are_found(robot):
    found = {str(file.relative_to(robot)) for file in asset_files(robot / "robot.xml")}
    assert found == {"robot.xml", "parts/assets.xml", "parts/body.xml", "meshes/part.obj", "pictures/t.png"}


@pytest.mark.parametrize("name", ["parts/body.xml", "meshes/part.obj"])
def test_a_changed_mesh_or_include_makes_another_cache_entry(robot, name):
    scene = native_scene(robot / "robot.xml")
    before = _cache_key(scene)
    assert _cache_key(scene) == before
    file = robot / name
    file.write_text(file.read_text().replace("turn", "spin").replace("v 1 0 0", "v 2 0 0"))
    assert _cache_key(scene) != before


def test_a_changed_mesh_of_a_urdf_robot_makes_another_cache_entry(tmp_path):
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes/part.obj").write_text(MESH)
    path = tmp_path / "robot.urdf"
    path.write_text(
        "<robot name='r'><link name='a'><visual><geometry><mesh filename='meshes/part.obj'/></geometry>"
        "</visual></link></robot>"
    )
    scene = native_scene(path, drive={"damping": 1.0, "limit": 1.0})
    before = _cache_key(scene)
    (tmp_path / "meshes/part.obj").write_text(MESH.replace("v 1 0 0", "v 2 0 0"))
    assert _cache_key(scene) != before


@pytest.mark.parametrize("name", sorted(shipped_scenes()))
def test_a_copy_of_a_shipped_scene_finds_its_assets(tmp_path, name):
    need_scene(name)
    copy = tmp_path / f"{name}.toml"
    copy.write_text((shipped_folder() / f"{name}.toml").read_text())
    assert _cache_key(load_scene(copy)) is not None
