# SPDX-License-Identifier: Apache-2.0
"""MJCF files that MuJoCo refuses: repaired with a warning, or one line with file, element and cure."""

import logging

import mujoco
import numpy as np
import pytest
from native_robots import native_scene

from warpmpc import SceneError
from warpmpc.scene.model.compiled import compile_scene

FILE = """
<mujoco><worldbody>
  <body name="arm"><joint name="swing" {joint}/>{arm}</body>
</worldbody>
<actuator><motor name="swing" joint="swing" ctrlrange="-1 1"/></actuator>{more}</mujoco>
"""
BALL = '<geom name="ball" size="0.1" pos="0.3 0 0" mass="1"/>'
FULL = "2 2 5 0.1 0.3 -0.2"


def inertial(inertia: str) -> str:
    return f'<inertial pos="0 0 0.1" mass="1" {inertia}/>'


@pytest.fixture
def compiled(tmp_path, monkeypatch):
    monkeypatch.setenv("WARPMPC_CACHE", str(tmp_path / "cache"))

    def compile_file(*, joint: str = "", arm: str = BALL, more: str = ""):
        (tmp_path / "arm.xml").write_text(FILE.format(joint=joint, arm=arm, more=more))
        return compile_scene(native_scene(tmp_path / "arm.xml"))

    return compile_file


def matrix(numbers: str) -> np.ndarray:
    a, b, c, ab, ac, bc = map(float, numbers.split())
    return np.array([[a, ab, ac], [ab, b, bc], [ac, bc, c]])


@pytest.mark.parametrize(
    ("inertia", "given"),
    [('diaginertia="1 1 5"', "1 1 5 0 0 0"), (f'fullinertia="{FULL}"', FULL), ('diaginertia="5 1 1"', "5 1 1 0 0 0")],
    ids=["last", "full", "first"],
)
def test_an_inertia_that_breaks_the_triangle_is_mended_with_a_warning(compiled, inertia, given, caplog):
    key = '<keyframe><key name="home" qpos="0.3"/></keyframe>'
    with caplog.at_level(logging.WARNING, logger="warpmpc"):
        scene = compiled(arm=inertial(inertia) + BALL, more=key)
    assert "body 'arm': no body has the principal inertias" in scene.repaired[0]
    assert scene.repaired[0] in caplog.text
    model = scene.spec().compile()
    body = next(b for b in range(model.nbody) if model.body(b).name.endswith("arm"))
    found, before = np.sort(model.body_inertia[body]), np.linalg.eigvalsh(matrix(given))
    assert found[0] + found[1] >= found[2]
    assert found[2] == pytest.approx(before[2], rel=1e-4)
    np.testing.assert_allclose(found[:2], before[:2] + 0.5 * (before[2] - before[0] - before[1]), rtol=1e-3)
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.body_iquat[body])
    axis = turn.reshape(3, 3)[:, np.argmax(model.body_inertia[body])]
    assert abs(axis @ np.linalg.eigh(matrix(given))[1][:, 2]) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(
    ("arm", "more"),
    [
        (inertial('diaginertia="1 2 3"'), ""),
        (inertial('diaginertia="1 1 5"'), '<compiler balanceinertia="true"/>'),
        (inertial('diaginertia="1 1 5"') + BALL, '<compiler inertiafromgeom="true"/>'),
    ],
    ids=["flat", "balanced by MuJoCo", "from geoms"],
)
def test_what_mujoco_takes_is_left_as_it_is(compiled, arm, more):
    scene = compiled(arm=arm, more=more)
    expected = mujoco.MjModel.from_xml_string(FILE.format(joint="", arm=arm, more=more))
    np.testing.assert_allclose(scene.spec().compile().body_inertia[-1], expected.body_inertia[-1], rtol=1e-6)
    assert scene.repaired == ()


def test_a_force_range_of_nothing_limits_nothing(compiled):
    scene = compiled(joint='actuatorfrclimited="true"')
    assert "joint 'swing': an actuatorfrcrange of 0 is taken as none" in scene.repaired[0]
    assert not scene.spec().compile().jnt_actfrclimited.any()


@pytest.mark.parametrize(
    ("joint", "arm", "says"),
    [
        ("", "", r"'arm' \(line 3\): it moves, and its mass or an inertia is not above zero: give it an <inertial>"),
        ("", inertial('diaginertia="0 0 0"'), r"'arm' \(line 3\): it moves, and its mass or an inertia"),
        ('limited="true"', BALL, r"'swing' \(line 3\): its range must begin below its end: correct range, or"),
        ('actuatorfrclimited="true" actuatorfrcrange="2 1"', BALL, r"'swing' \(line 3\): its actuatorfrcrange must"),
        ('axis="0 0 0"', BALL, r"'swing' \(line 3\): its axis has no length"),
        ("", '<geom name="ball" size="-1"/>', r"'ball' \(line 3\): its sizes must be above zero"),
    ],
    ids=["no mass", "no inertia", "no range", "force range reversed", "no axis", "negative size"],
)
def test_what_mujoco_refuses_is_said_with_file_line_and_cure(compiled, joint, arm, says):
    with pytest.raises(SceneError, match=says) as caught:
        compiled(joint=joint, arm=arm)
    assert "arm.xml" in str(caught.value)
    assert "mjMINVAL" not in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("what", ["ctrl", "force"])
def test_a_range_of_an_actuator_that_is_reversed_is_said_with_its_name_and_cure(compiled, what):
    motor = f'<motor name="second" joint="swing" {what}limited="true" {what}range="1 -1"/>'
    with pytest.raises(SceneError, match=rf"'second' \(line \d\): its {what}range must begin below its end"):
        compiled(more=f"<actuator>{motor}</actuator>")
