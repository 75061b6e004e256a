# SPDX-License-Identifier: Apache-2.0
"""Controls that plans start with hold the start state, where there are such controls."""

import mujoco
import numpy as np
import pytest

import warpmpc
from warpmpc.scene.model.compiled import compile_scene

DRONE = """<mujoco><compiler angle="radian"/><worldbody><body name="hull" pos="0 0 1"><freejoint/>
  <geom type="box" size=".1 .1 .02" mass=".8"/>
  <site name="a" pos=".1 .1 0"/><site name="b" pos="-.1 .1 0"/><site name="c" pos="-.1 -.1 0"/>
  <site name="d" pos=".1 -.1 0"/>{load}</body></worldbody><actuator>
  <motor name="a" site="a" gear="0 0 1 0 0 .01" ctrlrange="0 {limit}"/>
  <motor name="b" site="b" gear="0 0 1 0 0 -.01" ctrlrange="0 {limit}"/>
  <motor name="c" site="c" gear="0 0 1 0 0 .01" ctrlrange="0 {limit}"/>
  <motor name="d" site="d" gear="0 0 1 0 0 -.01" ctrlrange="0 {limit}"/></actuator></mujoco>"""
LOAD = """<body pos="0 0 0"><joint type="ball"/><geom type="capsule" fromto="0 0 0 0 0 -.5" size=".005" mass=".01"/>
  <geom type="sphere" size=".04" pos="0 0 -.5" mass=".19"/></body>"""
ARM = """<mujoco><compiler angle="radian"/><worldbody>
  <body pos="0 0 1"><joint name="shoulder" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="1"/>
  <body pos=".3 0 0"><joint name="elbow" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="1"/>
  </body></body></worldbody><actuator>
  <motor joint="shoulder" ctrlrange="-30 30"/><motor joint="elbow" ctrlrange="-30 30"/>
  </actuator></mujoco>"""
FALLS = """<mujoco><worldbody><body name="hull" pos="0 0 1"><freejoint/><geom type="box" size=".1 .1 .02" mass=".8"/>
  <body><joint name="flap" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass=".3"/></body>
  </body></worldbody><actuator><motor joint="flap" ctrlrange="-9 9"/></actuator></mujoco>"""
G = 9.81


def loaded(tmp_path, mjcf: str, **keys) -> warpmpc.Scene:
    (tmp_path / "robot.xml").write_text(mjcf)
    robot = {"name": "robot", "asset": str(tmp_path / "robot.xml"), **keys}
    planner = {"samples": 32, "noise": {"sigma": 0.05}}
    cost = [{"term": "height", "of": "robot", "target": 1.0}]
    return warpmpc.Scene.model_validate(
        {
            "timing": {"control_dt": 0.02, "timeout": 2.0},
            "robot": [robot],
            "ground": False,
            "cost": cost,
            "planner": planner,
        }
    )


def start_controls(scene: warpmpc.Scene) -> np.ndarray:
    return compile_scene(scene, cache=False).layout.control_start


@pytest.mark.parametrize(("load", "mass"), [("", 0.8), (LOAD, 1.0)], ids=["alone", "loaded"])
def test_a_drone_starts_at_hover(tmp_path, load, mass):
    controls = start_controls(loaded(tmp_path, DRONE.format(load=load, limit=9)))
    np.testing.assert_allclose(controls, mass * G / 4, rtol=1e-3)


def test_a_drone_too_weak_to_hover_starts_at_its_limit_or_nowhere(tmp_path):
    assert start_controls(loaded(tmp_path, DRONE.format(load="", limit=1.8))) == pytest.approx(
        1.8, rel=1e-2
    )  # 8 % short
    assert not start_controls(loaded(tmp_path, DRONE.format(load="", limit=0.5))).any()


@pytest.mark.parametrize("q", [(0.0, 0.0), (0.4, -1.2), (-2.0, 0.7)])
def test_an_arm_holds_its_posture(tmp_path, q):
    controls = start_controls(loaded(tmp_path, ARM, joint_q={"shoulder": q[0], "elbow": q[1]}))
    model = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(model)
    data.qpos, data.ctrl = q, controls
    mujoco.mj_forward(model, data)
    assert np.abs(data.qacc).max() < 1e-3


def test_a_body_that_nothing_holds_has_no_such_controls(tmp_path):
    assert not start_controls(loaded(tmp_path, FALLS)).any()


def test_the_first_second_of_a_drone_without_a_keyframe_is_no_fall(tmp_path):
    scene = loaded(tmp_path, DRONE.format(load="", limit=9))
    controller, plant = warpmpc.Controller(scene, seed=3), warpmpc.Plant(scene, seed=3)
    lowest = 1.0
    for _ in range(50):
        plant.apply(controller.step(plant.observe()))
        lowest = min(lowest, float(plant.observe().joint_q[2]))
    assert lowest > 0.9
