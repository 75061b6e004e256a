# SPDX-License-Identifier: Apache-2.0
"""A planner in a process of its own: it steers, is killed in the middle, and comes back."""

import os
import signal
import time

import numpy as np
import pytest
from faulty_robots import FaultyRobot
from rerun.chunk import RrdReader
from small_scenes import make_scene

from warpmpc import History, PlannerProcess, RobotLoop, SceneError, TickRecorder, simulated_robot
from warpmpc.realtime.watchdog import FaultKind
from warpmpc.record.tick_recording import record_ticks

SPEED = 0.1
"""The robot's seconds in a second: tests share their cores with others."""


def logged_text(path, at) -> list[str]:
    """The log lines of an entity of a recording."""
    chunks = [chunk for chunk in RrdReader(path).stream() if chunk.entity_path == at]
    return [
        text for chunk in chunks for text in chunk.to_record_batch().column("TextLog:text").to_pylist() for text in text
    ]


def broken_terms():
    raise ValueError("there is nothing here")


def test_a_planner_that_is_killed_is_replaced_and_the_robot_gets_the_safe_command_meanwhile(caplog, tmp_path):
    scene = make_scene(plant={"randomize": False}, engine={"threads": 1})
    with PlannerProcess(scene, speed=SPEED, engine="mujoco", device="cpu") as planner:
        robot = FaultyRobot(simulated_robot(scene, task=planner.task, compiled=planner.compiled))
        recorder = TickRecorder(robot.plant)
        loop = RobotLoop(scene, robot, planner, speed=SPEED, simulated=True, recorder=recorder)
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

    recorder.history(report.faults).save(tmp_path / "run.npz")
    history = History.load(tmp_path / "run.npz")
    ticks = history.ticks
    assert len(ticks.plan) == report.ticks  # nothing is lost
    sent = {round(moment, 6): control for moment, control in robot.sent}
    for reached, control in zip(history.time[1:], history.control, strict=True):
        np.testing.assert_array_equal(control.astype(np.float32), sent[round(reached - 1.0 / scene.agent.rate, 6)])
    gap = (history.time[1:] > killed + 0.1) & (history.time[1:] < fault.end)
    assert not ticks.following[gap].any()
    assert ticks.following[history.time[1:] > fault.end + 0.01].all()
    assert ticks.faults == report.faults
    record_ticks(tmp_path / "run.rrd", history, robot.plant)
    said = logged_text(tmp_path / "run.rrd", "/faults")
    assert any("there is no plan for" in line for line in said)
    assert any("following the plan again" in line for line in said)


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
