# SPDX-License-Identifier: Apache-2.0
"""A planner that is killed in the middle of a run: nothing is lost from what is recorded."""

import os
import signal
import time
from dataclasses import replace

import numpy as np
from faulty_robots import FaultyRobot
from rerun.chunk import RrdReader
from small_scenes import make_scene

from warpmpc import PlannerProcess, RobotLoop, RunLog, RunRecorder, State, replay, simulated_robot
from warpmpc.extras.record.tick_recording import record_ticks
from warpmpc.loop.log.run_log import read_planners
from warpmpc.loop.realtime.agent import Fault
from warpmpc.loop.realtime.messages import TimedObservation

SPEED = 0.1
"""The robot's seconds in a second: tests share their cores with others."""


def logged_text(path, at) -> list[str]:
    """The log lines of an entity of a recording."""
    chunks = [chunk for chunk in RrdReader(path).stream() if chunk.entity_path == at]
    return [
        text for chunk in chunks for text in chunk.to_record_batch().column("TextLog:text").to_pylist() for text in text
    ]


def test_a_planner_that_cannot_note_its_plans_plans_all_the_same(caplog, tmp_path):
    scene = make_scene(plant={"randomize": False}, engine={"threads": 1})
    planner = PlannerProcess(scene, engine="mujoco", device="cpu", log=tmp_path / "a.runlog")
    (tmp_path / "a.runlog.0").mkdir()  # where it would write: a file of that name cannot be made
    with planner:
        start = State.start(planner.layout)
        planner.observe(TimedObservation(replace(start, time=0.0), np.zeros(3), False))
        deadline = time.monotonic() + 60.0
        while planner.newest() is None and time.monotonic() < deadline:
            time.sleep(0.01)
    assert planner.newest().number == 0
    assert read_planners(tmp_path / "a.runlog") is None
    assert caplog.messages == ["of plans 0 to 0 those after -1 could not be logged"]


def test_a_record_of_a_run_whose_planner_was_killed_is_whole(tmp_path):
    near = {"frame": "base/centre", "position": (0.7, 0.35)}  # half of the way is left when the planner is killed
    scene = make_scene(plant={"randomize": False}, engine={"threads": 1}, goal=near)
    with PlannerProcess(scene, speed=SPEED, engine="mujoco", device="cpu", log=tmp_path / "a.runlog") as planner:
        robot = FaultyRobot(simulated_robot(scene, task=planner.task, compiled=planner.compiled))
        recorder = RunRecorder(robot.plant, path=tmp_path / "a.runlog")
        loop = RobotLoop(scene, robot, planner, speed=SPEED, simulated=True, recorder=recorder)
        loop.run(lambda: robot.plant.time >= 0.4)
        assert loop.agent.following
        killed = robot.plant.time
        os.kill(planner.pid, signal.SIGKILL)
        deadline = time.monotonic() + 60.0
        loop.run(lambda: robot.plant.time > killed + 0.15)
        assert not loop.agent.following
        fault = loop.agent.fault
        loop.run(lambda: loop.agent.following or time.monotonic() > deadline)
        again = robot.plant.time
        loop.run(lambda: robot.plant.done or robot.plant.time > again + 0.1)
        report = loop.report()
    assert fault.end is not None

    recorder.close()
    RunLog.load(tmp_path / "a.runlog").save(tmp_path / "run.npz")
    log = RunLog.load(tmp_path / "run.npz")
    ticks, reached = log.controls, log.states.time[1:]
    assert len(ticks.plan) == report.ticks  # nothing is lost
    sent = {round(moment, 6): control for moment, control in robot.sent}
    for moment, control in zip(reached, ticks.control, strict=True):
        np.testing.assert_array_equal(control.astype(np.float32), sent[round(moment - 1.0 / scene.agent.rate, 6)])
    gap = (reached > killed + 0.1) & (reached < fault.end)
    assert not ticks.following[gap].any()
    tick = 1.0 / scene.agent.rate
    told = [(f.start - tick, (np.inf if f.end is None else f.end) + 2.0 * tick) for f in report.faults]
    for moment in reached[~ticks.following]:  # a busy machine may bring its own faults
        assert moment < 0.4 or any(start <= moment <= end for start, end in told)
    assert Fault.of(log) == report.faults

    made = log.plans
    assert set(made.life.tolist()) == {0, 1}
    assert set(ticks.plan[ticks.plan >= 0].tolist()) <= set(made.number.tolist())  # no plan of the killed one is lost
    again = replay(log)
    assert again.plans.same, again.plans.first
    assert again.commands.same, again.commands.first
    record_ticks(tmp_path / "run.rrd", log, robot.plant)
    said = logged_text(tmp_path / "run.rrd", "/faults")
    assert any(fault.why in line for line in said)
    assert any("following the plan again" in line for line in said)
