# SPDX-License-Identifier: Apache-2.0
"""The cache of compiled scenes: what comes back, what it depends on, and what a damaged entry does."""

import shutil
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from small_scenes import BOX, CHAIN, WALL, chain_scene, make_scene

from warpmpc import load_scene
from warpmpc.scene.model.compiled import _cache_key, compile_scene


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache folder."""
    monkeypatch.setenv("WARPMPC_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "scenes"


def small():
    return make_scene(object=[BOX], obstacle=[WALL])


def assert_same(a, b) -> None:
    """Assert that two compiled scenes are equal in all their parts."""
    assert a.mjcf == b.mjcf
    assert (a.body_name, a.geom_name, a.joint_name) == (b.body_name, b.geom_name, b.joint_name)
    for item in fields(a.layout):
        x, y = getattr(a.layout, item.name), getattr(b.layout, item.name)
        if isinstance(x, np.ndarray):
            assert x.dtype == y.dtype
            np.testing.assert_array_equal(x, y, err_msg=item.name)
        elif item.name != "meshes":
            assert x == y, item.name
    for x, y in zip(a.layout.meshes, b.layout.meshes, strict=True):
        np.testing.assert_array_equal(x[0], y[0])
        np.testing.assert_array_equal(x[1], y[1])


def test_the_cache_gives_back_what_was_compiled(cache):
    first = compile_scene(small())
    assert len(list(cache.glob("*"))) == 3
    assert_same(first, compile_scene(small()))
    assert_same(first, compile_scene(small(), cache=False))


def test_a_cached_scene_needs_no_newton(cache):
    compile_scene(small())
    program = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "import quick_kernels; quick_kernels.compile_soonest()\n"
        "from small_scenes import BOX, WALL, make_scene\n"
        "from warpmpc import Controller, Plant\n"
        "scene = make_scene(object=[BOX], obstacle=[WALL], planner={'samples': 4, 'horizon': 2})\n"
        "Controller(scene).step(Plant(scene).observe())\n"
        "print('newton' in sys.modules)\n"
    )
    tests = str(Path(__file__).parents[2] / "helpers")
    out = subprocess.run([sys.executable, "-c", program, tests], capture_output=True, text=True, timeout=120)
    assert out.stdout.split()[-1] == "False", out.stdout + out.stderr


@pytest.mark.parametrize("ending", ["npz", "xml", "json"])
@pytest.mark.parametrize("damage", ["cut", "emptied", "garbled", "gone"])
def test_a_damaged_entry_is_built_anew(cache, ending, damage, monkeypatch):
    reference = compile_scene(small())
    (file,) = cache.glob(f"*.{ending}")
    whole = file.read_bytes()
    middle = len(whole) // 2
    match damage:
        case "cut":
            file.write_bytes(whole[:middle])
        case "emptied":
            file.write_bytes(b"")
        case "garbled":
            file.write_bytes(whole[:middle] + b"#" * 20 + whole[middle + 20 :])
        case "gone":
            file.unlink()
    built = []
    from warpmpc.scene.model import compiled

    build = compiled._compile
    monkeypatch.setattr(compiled, "_compile", lambda scene: built.append(scene) or build(scene))
    assert_same(reference, compile_scene(small()))
    assert len(built) == 1
    compile_scene(small())
    assert len(built) == 1  # and was stored again


def test_a_cache_that_cannot_be_written_is_no_error(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("WARPMPC_CACHE", str(tmp_path / "file"))
    assert compile_scene(small()).layout.nu == 3


def test_the_key_follows_the_bodies_and_not_the_task(tmp_path):
    key = _cache_key(small())
    same = make_scene(object=[BOX], obstacle=[WALL], cost=[{"term": "control_effort"}], planner={"samples": 7})
    assert _cache_key(same) == key
    for changed in (
        make_scene(object=[{**BOX, "mass": 1.1}], obstacle=[WALL]),
        make_scene(object=[BOX], obstacle=[{**WALL, "position": (1.5, 0.1, 0.2)}]),
        make_scene(object=[BOX], obstacle=[WALL], ground={"friction": 0.2}),
        make_scene(object=[BOX], obstacle=[WALL], ground=None),
    ):
        assert _cache_key(changed) != key
    scene = chain_scene(tmp_path)
    before = _cache_key(scene)
    assert _cache_key(scene) == before
    (tmp_path / "chain.xml").write_text(CHAIN.replace('mass="2"', 'mass="3"'))
    assert _cache_key(scene) != before


def test_a_changed_mesh_of_a_robot_changes_the_key(tmp_path):
    (tmp_path / "part.stl").write_bytes(b"one")
    (tmp_path / "robot.urdf").write_text(
        '<robot name="r"><link name="l"><visual><geometry><mesh filename="part.stl"/></geometry></visual></link>'
        "</robot>"
    )
    robot = {"name": "r", "asset": str(tmp_path / "robot.urdf"), "drive": {"damping": 1.0, "limit": 1.0}}
    scene = make_scene(robot=[robot])
    before = _cache_key(scene)
    (tmp_path / "part.stl").write_bytes(b"longer")
    assert _cache_key(scene) != before


def test_names_lead_to_the_bodies_joints_and_geoms_they_stand_for(cache, tmp_path):
    compiled = compile_scene(chain_scene(tmp_path))
    layout, model = compiled.layout, compiled.spec().compile()
    for link, name in zip(layout.body_name, compiled.body_name, strict=True):
        assert model.body(name).name.endswith(link.split("/")[-1])
    sizes = {0: 7, 1: 4, 2: 1, 3: 1}
    named = [(dof, model.joint(name)) for dof, name in enumerate(compiled.joint_name) if name]
    assert [int(joint.type[0]) for _, joint in named] == [0, 1, 3, 3, 3, 2, 3, 3]
    assert sum(sizes[int(joint.type[0])] for _, joint in named) == model.nq
    for dof, joint in named:
        assert dof in layout.joint_qd_start or int(joint.type[0]) >= 2
    for shape, name in zip(layout.shapes, compiled.geom_name, strict=True):
        owner = model.geom(name).bodyid[0]
        assert model.body(owner).name == compiled.body_name[shape.body]


@pytest.mark.parametrize("name", ["pendulum", "point_reach"])
def test_a_shipped_scene_that_comes_compiled_is_not_built_wherever_it_is_installed(name, cache, tmp_path, monkeypatch):
    from warpmpc.scene import load
    from warpmpc.scene.model import compiled

    here = load_scene(name)
    reference = compile_scene(here, cache=False)
    monkeypatch.setenv("WARPMPC_KERNELS", str(tmp_path / "objects"))
    compiled.compile_shipped(tmp_path / "objects" / "scenes", [here])
    elsewhere = tmp_path / "installed"
    shutil.copytree(load.shipped_folder(), elsewhere)
    for module in (load, compiled):
        monkeypatch.setattr(module, "shipped_folder", lambda: elsewhere)
    there = load_scene(name)
    assert there.path.is_relative_to(elsewhere)
    monkeypatch.setattr(compiled, "_compile", lambda scene: pytest.fail("it was built"))
    found = compile_scene(there)
    assert found.mjcf == reference.mjcf
    assert all(Path(robot.path).is_relative_to(elsewhere) for robot in found.mjcf_robots)
    assert not cache.exists()
