# SPDX-License-Identifier: Apache-2.0
"""Where assets are found, what they are, and what is said when they are nowhere."""

import re
from pathlib import Path

import pytest
from needs import needs

from warpmpc import SceneError
from warpmpc.scene.load import shipped_folder
from warpmpc.scene.model.assets import (
    AssetKind,
    asset_kind,
    package_dirs,
    resolve_asset,
)

PANDA = "package://example-robot-data/robots/panda_description/urdf/panda.urdf"
needs_robots = needs("example-robot-data")


def resolve(uri, base=None):
    return resolve_asset(uri, base=base, key="robot.arm.asset", file="scene.toml")


def put(path: Path, text: str = "<robot/>") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


def test_a_uri_finds_files_of_an_installed_python_package_without_importing_it(tmp_path, monkeypatch):
    package = tmp_path / "site" / "robots_of_mine"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("raise RuntimeError")
    (package / "arm.xml").write_text("<mujoco/>")
    monkeypatch.syspath_prepend(package.parent)
    assert resolve("package://robots_of_mine/arm.xml") == package / "arm.xml"
    with pytest.raises(SceneError, match="no such file"):
        resolve("package://robots_of_mine/leg.xml")


def test_a_file_beside_the_scene_goes_first(tmp_path):
    mine = put(tmp_path / "omni_base.urdf")
    assert resolve("omni_base.urdf", tmp_path) == mine
    assert resolve("omni_base.urdf", tmp_path / "elsewhere") == shipped_folder() / "assets" / "omni_base.urdf"


def test_absolute_paths_and_file_uris_are_taken_as_they_are(tmp_path):
    path = put(tmp_path / "a b" / "robot.urdf")
    assert resolve(str(path)) == path
    assert resolve(path.as_uri()) == path


def test_without_a_scene_file_paths_start_at_the_working_directory(tmp_path, monkeypatch):
    path = put(tmp_path / "robot.urdf")
    monkeypatch.chdir(tmp_path)
    assert resolve("robot.urdf") == path


def test_newtons_own_assets_are_found_by_name():
    assert resolve("nv_humanoid.xml").is_file()


@needs_robots
def test_robot_packages_from_pypi_need_no_environment_variable(monkeypatch):
    monkeypatch.delenv("ROS_PACKAGE_PATH", raising=False)
    assert resolve(PANDA).name == "panda.urdf"


@needs_robots
def test_a_robots_own_meshes_are_found_where_the_robot_is(monkeypatch):
    monkeypatch.delenv("ROS_PACKAGE_PATH", raising=False)
    path = resolve(PANDA)
    meshes = re.findall(r'filename="package://([^"]+)"', path.read_text(encoding="utf-8"))
    assert len(meshes) > 10
    assert all(any((folder / mesh).is_file() for folder in package_dirs(path)) for mesh in meshes)


def test_packages_on_the_ros_path_are_found(tmp_path, monkeypatch):
    path = put(tmp_path / "my_robot" / "urdf" / "arm.urdf")
    monkeypatch.setenv("ROS_PACKAGE_PATH", f"{tmp_path}:/nowhere")
    assert resolve("package://my_robot/urdf/arm.urdf") == path


def test_a_urdf_finds_the_package_it_lies_in(tmp_path):
    path = put(tmp_path / "ws" / "my_robot" / "urdf" / "arm.urdf")
    assert tmp_path / "ws" in package_dirs(path)
    assert tmp_path / "ws" not in package_dirs()


def test_a_missing_file_names_the_places_searched_and_what_is_near(tmp_path):
    near = put(tmp_path / "assets" / "my_arm.urdf")
    with pytest.raises(SceneError) as caught:
        resolve("assets/my_amr.urdf", tmp_path)
    text = str(caught.value)
    assert text.startswith("scene.toml: robot.arm.asset: no such file")
    assert f"searched {tmp_path / 'assets'}, {shipped_folder() / 'assets'}" in text
    assert f"Similar files: {near}" in text
    assert "found 'assets/my_amr.urdf'" in text


@needs_robots
def test_a_missing_file_of_a_package_suggests_its_neighbours():
    with pytest.raises(SceneError, match=r"robot\.arm\.asset: no such file .*Similar files: .*panda\.urdf"):
        resolve(PANDA.replace("panda.urdf", "pnda.urdf"))


def test_a_package_that_is_not_installed_is_named_with_its_cure():
    with pytest.raises(
        SceneError, match=r"There is no package no_such_robot here; .* pip install --no-deps no-such-robot"
    ):
        resolve("package://no_such_robot/robot.xml")


def test_a_folder_is_no_asset(tmp_path):
    for uri in (str(tmp_path), ".", "file:" + str(tmp_path)):
        with pytest.raises(SceneError, match="no such file"):
            resolve(uri, tmp_path)


def test_nothing_is_downloaded():
    with pytest.raises(
        SceneError, match=r"this kind of address is not read; found 'https://a/b\.urdf'; allowed: a path"
    ):
        resolve("https://a/b.urdf")


@pytest.mark.parametrize(
    ("name", "text", "kind"),
    [
        ("a.urdf", '<?xml version="1.0"?>\n<!-- c -->\n<robot name="a"><link name="b"/></robot>', AssetKind.URDF),
        ("a.xml", "<mujoco/>", AssetKind.MJCF),
        ("a.mjcf", "<mujoco/>", AssetKind.MJCF),
        ("a.xml", "<robot/>", AssetKind.URDF),
        ("a.urdf", "<mujoco/>", AssetKind.MJCF),
        ("a.USDA", "#usda 1.0", AssetKind.USD),
        ("a.usdz", "", AssetKind.USD),
    ],
)
def test_the_kind_of_an_asset_shows_in_its_ending_and_root(tmp_path, name, text, kind):
    assert asset_kind(put(tmp_path / name, text)) is kind


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("a.sdf", "<sdf/>", "no such kind of robot asset; found 'a.sdf'; allowed: URDF"),
        ("a.xml", "<sdf/>", "is neither URDF nor MJCF; found '<sdf>'; allowed: a root element <robot>"),
        ("a.xml", "<mujoco", "is not valid XML"),
        ("a.urdf", "", "is not valid XML"),
        ("a.urdf.xacro", "<robot/>", "must be expanded first: xacro a.urdf.xacro > a.urdf"),
        ("a.urdf", "<robot><xacro:arm/></robot>", "must be expanded first"),
    ],
)
def test_other_assets_are_refused_with_a_reason(tmp_path, name, text, says):
    with pytest.raises(SceneError) as caught:
        asset_kind(put(tmp_path / name, text), key="robot.arm.asset", file="scene.toml")
    assert str(caught.value).startswith("scene.toml: robot.arm.asset: ")
    assert says in str(caught.value)
