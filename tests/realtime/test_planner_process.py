# SPDX-License-Identifier: Apache-2.0
"""A planner in a process of its own: it steers, is killed in the middle, and comes back."""

import os
import signal
import time

import numpy as np
import pytest
from faulty_robots import FaultyRobot
from small_scenes import make_scene

from warpmpc import PlannerProcess, RobotLoop, SceneError, simulated_robot
from warpmpc.realtime.watchdog import FaultKind

SPEED = 0.1
"""The robot's seconds in a second: tests share their cores with others."""


def broken_terms():
    raise ValueError("there is nothing here")


def test_a_planner_that_is_killed_is_replaced_and_the_robot_gets_the_safe_command_meanwhile(caplog):
    scene = make_scene(plant={"randomize": False}, engine={"threads": 1})
    with PlannerProcess(scene, speed=SPEED, engine="mujoco", device="cpu") as planner:
        robot = FaultyRobot(simulated_robot(scene, task=planner.task, compiled=planner.compiled))
        loop = RobotLoop(scene, robot, planner, speed=SPEED, simulated=True)
        loop.run(lambda: robot.plant.time >= 0.4)
        assert loop.agent.following
        assert robot.plant.state.joint_qd[0] > 0.2  # on its way
        killed, pid = robot.plant.time, planner.pid
        caplog.clear()
        number = planner.newest().number
        os.kill(pid, signal.SIGKILL)
        deadline = time.monotonic() + 60.0
        loop.run(lambda: robot.plant.time > killed + 0.15)
        assert not loop.agent.following
        unsafe = [moment for moment, control in robot.sent if control.any()]
        assert max(unsafe) - killed + 1.0 / scene.agent.rate <= 0.1
        fault = loop.agent.fault
        assert fault.kind is FaultKind.PLAN_MISSING
        loop.run(lambda: loop.agent.following or time.monotonic() > deadline)
        assert planner.pid != pid
        assert planner.newest().number > number  # never taken for one of the planner before
        loop.run(lambda: robot.plant.done)
        report = loop.report()
    assert robot.plant.success
    assert fault.end is not None
    assert sum("the planner's process died (exit code -9)" in line for line in caplog.messages) == 1
    assert sum("the newest plan is from what was observed" in line for line in caplog.messages) >= 1
    assert report.plans > 10
    assert 0.0 < report.latency_ms["p50"] < report.latency_ms["max"]
    assert report.jitter_ms["p50"] < 1e3 / SPEED
    assert not robot.sent[-1][1].any()  # it is left with the safe command


def test_what_the_task_wants_reaches_the_planner():
    scene = make_scene(plant={"randomize": False}, engine={"threads": 1})
    with PlannerProcess(scene, speed=SPEED, engine="mujoco", device="cpu") as planner:
        robot = simulated_robot(scene, task=planner.task, compiled=planner.compiled)
        planner.task["goal"] = [-1.0, -0.5, 0.0, 0.0, 0.0, 0.0, 1.0]
        RobotLoop(scene, robot, planner, speed=SPEED, simulated=True).run(lambda: robot.done)
        assert robot.success
        np.testing.assert_allclose(robot.state.joint_q[:2], [-1.0, -0.5], atol=0.11)


def test_what_keeps_the_planner_from_starting_is_raised_here():
    scene = make_scene(engine={"threads": 1})
    with pytest.raises(ValueError, match="there is nothing here"), PlannerProcess(scene, terms=broken_terms):
        pass
    wrong = make_scene(cost=[{"term": "distance", "between": ["base/elbow", "goal"]}])
    with pytest.raises(SceneError, match="elbow"), PlannerProcess(wrong, engine="mujoco"):
        pass
