# SPDX-License-Identifier: Apache-2.0
"""The safe command of arms driven by efforts: what holds the start, or gravity balanced wherever they are."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from small_scenes import make_scene

from warpmpc import SceneError, simulated_robot
from warpmpc.loop.realtime.agent import Agent
from warpmpc.scene.model.compiled import compile_scene

ARM = """
<mujoco><compiler angle="radian" autolimits="true"/><worldbody>
  <body name="upper" pos="0 0 1"><joint name="shoulder" axis="0 1 0" damping="0.1"/>
    <geom type="capsule" size=".03" fromto="0 0 0 .4 0 0" mass="2"/>
    <body name="fore" pos=".4 0 0"><joint name="elbow" axis="0 1 0" damping="0.1" stiffness="2" springref="0.5"/>
      <geom type="capsule" size=".03" fromto="0 0 0 .3 0 0" mass="1"/>
    </body>
  </body>
</worldbody>{actuators}</mujoco>
"""
MOTORS = """<actuator>
  <motor joint="elbow" gear="3" ctrlrange="-9 9"/> <motor joint="shoulder" gear="-50" ctrlrange="-1 1"/>
</actuator>"""
DRIVE = {"drive": {"mode": "effort", "effort_limit": 40.0}}


def arm(folder, drive: dict, actuators: str = "", **agent):
    """A scene of an arm that lies level."""
    path = folder / "arm.xml"
    path.write_text(ARM.format(actuators=actuators))
    robot = {"name": "arm", "asset": str(path), "joint_q": [0.0, 0.3]} | drive
    goal = {"frame": "arm/fore", "position": (0.5, 0.0)}
    sections = {"robot": [robot], "goal": goal, "cost": [{"term": "joint_velocity"}], "ground": None}
    return make_scene(plant={"randomize": False}, agent=agent, **sections)


def droop(scene) -> float:
    """How far joints get in a second in which there is no plan [rad]."""
    robot = simulated_robot(scene)
    agent, start = Agent(scene, robot.layout), robot.state.joint_q
    for _ in range(round(scene.agent.rate)):
        robot.apply(agent.command(robot.observe(), None, robot.time))
    return float(np.abs(robot.state.joint_q - start).max())


def imbalance(scene, posture: list[float]) -> float:
    """Largest acceleration under the safe command of an arm at rest in a posture [rad/s²]."""
    robot = simulated_robot(scene)
    seen = replace(robot.observe(), joint_q=np.array(posture, dtype=np.float32))
    command = Agent(scene, robot.layout).command(seen, None, robot.time)
    data = mujoco.MjData(robot.model)
    data.qpos, data.ctrl = posture, robot.world.actuator_matrix @ command + robot.world.actuator_offset
    mujoco.mj_forward(robot.model, data)
    return float(np.abs(data.qacc).max())


@pytest.mark.parametrize(("drive", "actuators"), [(DRIVE, ""), ({}, MOTORS)], ids=["drive", "motors"])
def test_an_arm_stays_at_its_start_and_where_gravity_is_balanced_anywhere(drive, actuators, tmp_path):
    rest, balanced = (arm(tmp_path, drive, actuators, safe=safe) for safe in ("rest", "gravity"))
    assert droop(rest) < 0.02
    assert droop(balanced) < 0.02
    assert imbalance(rest, [1.0, -0.5]) > 1.0
    assert imbalance(balanced, [1.0, -0.5]) < 0.05


def test_efforts_stay_within_their_limits(tmp_path):
    weak = arm(tmp_path, {"drive": {"mode": "effort", "effort_limit": 2.0}}, safe="gravity")
    robot = simulated_robot(weak)
    sent = Agent(weak, robot.layout).command(robot.observe(), None, 0.0)
    assert np.abs(sent).max() == pytest.approx(2.0)


def test_a_robot_without_efforts_is_refused_by_its_key():
    scene = make_scene(agent={"safe": "gravity"})
    with pytest.raises(SceneError, match=r"agent\.safe.*no control of this scene is an effort"):
        Agent(scene, compile_scene(scene).layout)
