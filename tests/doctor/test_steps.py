# SPDX-License-Identifier: Apache-2.0
"""Physics steps longer than an MJCF file's: their error over a plan is told, and a mistake where it is large."""

import pytest

from warpmpc.controller.controller import Controller
from warpmpc.doctor.steps import step_error
from warpmpc.plant.plant import Plant
from warpmpc.scene.load import load_scene

PENDULUM = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body name="arm" pos="0 0 1">
      <joint name="hinge" axis="0 1 0" stiffness="%s" springref="1"/>
      <geom type="capsule" fromto="0 0 0 .5 0 0" size=".03" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor name="hinge" joint="hinge" ctrlrange="-5 5"/></actuator>
</mujoco>
"""
SCENE = """
timing = { control_dt = 0.02, timeout = 2.0 }

[[robot]]
name = "arm"
asset = "arm.xml"

[engine]
substeps = %d
integrator = "euler"

[[cost]]
term = "control_effort"

[planner]
samples = 16
horizon = 50
dt = 0.02

[planner.noise]
sigma = { range = 0.2 }
"""


def found(folder, substeps, stiffness="0"):
    """Step error of an arm on a hinge, with or without a spring."""
    (folder / "arm.xml").write_text(PENDULUM % stiffness)
    (folder / "scene.toml").write_text(SCENE % substeps)
    scene = load_scene(folder / "scene.toml")
    controller, seen = Controller(scene, engine="mujoco", device="cpu"), Plant(scene).observe()
    for _ in range(2):
        controller.step(seen)
    return step_error(controller)


def test_steps_as_long_as_the_files_have_no_error(tmp_path):
    assert found(tmp_path, 10) is None


def test_a_longer_step_is_told_with_a_small_error(tmp_path):
    error = found(tmp_path, 5)
    assert (error.step, error.wanted, error.ahead) == pytest.approx((0.004, 0.002, 1.0))
    assert error.body == "arm/arm"
    assert 0.0 < error.error < 0.05 < error.moved
    assert str(error).startswith("4 ms where the file says 2 ms; over 1 s of the plan this moves arm/arm by ")
    assert error.finding is None


def test_a_step_too_long_for_a_stiff_spring_is_a_finding(tmp_path):
    error = found(tmp_path, 1, "2000")
    assert error.finding is not None, error
    assert error.finding.key == "engine.substeps"
    assert "up to 10-fold" in error.finding.cure
