# SPDX-License-Identifier: Apache-2.0
"""What of an asset is not as its file says is shown every time, in one line, and listed by ``check``."""

import pytest

URDF = """
<robot name="r"><link name="base"/>
  <joint name="turn" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="0" velocity="2"/></joint>
  <link name="arm"><inertial><mass value="1"/><inertia ixx=".1" iyy=".1" izz=".3" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><mesh filename="package://foo/x.stl"/></geometry></visual></link>
</robot>
"""
SCENE = """
ground = false

[[robot]]
name = "r"
asset = "r.urdf"
drive = { mode = "effort", effort_limit = 1.0, limit = [1.0] }

[[cost]]
term = "joint_velocity"

[engine]
name = "mujoco"

[planner]
samples = 8
horizon = 4
noise = { sigma = [0.1] }

[success]
conditions = { term = "joint_velocity", below = 1e-9 }
"""


@pytest.fixture
def files(tmp_path, monkeypatch):
    monkeypatch.setenv("WARPMPC_CACHE", str(tmp_path / "cache"))
    (tmp_path / "r.urdf").write_text(URDF)
    (tmp_path / "r.toml").write_text(SCENE)
    return tmp_path


def test_what_was_mended_is_shown_every_time_and_listed_by_check(files, command):
    shown = []
    for _ in range(2):  # the second comes from the cache
        done = command("check", "r.toml")
        assert done.returncode == 0, done.stderr
        listed = " ".join(done.stdout.split())
        assert listed.count("repaired r: ") == 3
        assert all(part in listed for part in ("package://foo/x.stl", "A + B ≥ C", "limit of 0 for effort"))
        shown.append([line for line in done.stderr.splitlines() if line.startswith("warning: ")])
    assert shown[0] == shown[1]
    assert len(shown[0]) == 1
    assert "and 2 more repaired" in shown[0][0]


@pytest.mark.parametrize("engine", ["mujoco", "mujoco_warp"])
def test_what_newton_corrects_is_listed_by_body_without_advice_on_newton(files, command, engine):
    light = URDF.replace('value="1"', 'value="1e-9"').replace('".1"', '"0"').replace('".3"', '"0"')
    (files / "r.urdf").write_text(light.replace("package://foo/x.stl", "x.stl"))
    done = command("check", "r.toml", "--engine", engine)
    assert done.returncode == 0
    said = " ".join((done.stdout + done.stderr).split())
    assert "r/arm" in said.partition("Eigenvalues below threshold")[2]
    assert "validat" not in said
    assert ".py:" not in said


def test_a_missing_collision_mesh_is_one_line_with_file_link_and_path(files, command):
    (files / "r.urdf").write_text(URDF.replace("visual>", "collision>"))
    done = command("run", "r.toml")
    assert (done.returncode, done.stdout) == (2, "")
    [line] = done.stderr.splitlines()
    assert all(part in line for part in ("r.toml", "robot.r.asset", "r.urdf", "link 'arm'", "package://foo/x.stl"))
