# SPDX-License-Identifier: Apache-2.0
"""The fault drill on a robot in motion whose planner is a process: it is safe soon, and recovers."""

import logging
import os
import signal
import time

import numpy as np
import pytest
from faulty_robots import FaultyPlanner, FaultyRobot
from small_scenes import make_scene

from warpmpc import PlannerProcess, RobotLoop, simulated_robot

SPEED = 0.2
"""The robot's seconds in a second: tests share their cores with others."""
SOON = 0.1
"""Within this time after a fault the robot has the safe command, by its own clock [s]."""
STALL = 2.0
"""How long the planner stalls, of wall time [s]."""


class Drill:
    """A disc on a long way, driven by a planner's process."""

    def __init__(self, scene, process: PlannerProcess):
        self.process, self.planner = process, FaultyPlanner(process)
        self.robot = FaultyRobot(simulated_robot(scene, task=process.task, compiled=process.compiled))
        self.loop = RobotLoop(scene, self.robot, self.planner, speed=SPEED, simulated=True)

    @property
    def now(self) -> float:
        return self.robot.plant.time

    def run(self, *, until) -> None:
        deadline = time.monotonic() + 100.0

        def over() -> bool:
            assert time.monotonic() < deadline, "it took too long"
            return until()

        self.loop.run(over)

    def run_for(self, seconds: float) -> None:
        end = self.now + seconds
        self.run(until=lambda: self.now >= end - 1e-9)

    def kill(self) -> None:
        os.kill(self.process.pid, signal.SIGKILL)

    def stop(self) -> None:
        os.kill(self.process.pid, signal.SIGSTOP)

    def go_on(self) -> None:
        os.kill(self.process.pid, signal.SIGCONT)

    def trust(self) -> None:
        self.robot.spoil = self.planner.spoil = None


FAULTS = {  # what goes wrong, how long [s] of the robot's time, how it ends, what the log says
    "planner killed": (Drill.kill, 0.2, lambda drill: None, "the newest plan is from what was observed 0.09"),
    "planner stalls": (Drill.stop, STALL * SPEED, Drill.go_on, "the newest plan is from what was observed 0.09"),
    "not finite": (lambda drill: drill.robot.forget_numbers(), 0.2, Drill.trust, "the observation is not finite"),
    "frozen": (lambda drill: drill.robot.freeze(), 0.2, Drill.trust, "the observation is 0.05"),
    "joints frozen": (lambda drill: drill.robot.freeze_joints(), 0.2, Drill.trust, "the observation is frozen"),
    "back in time": (lambda drill: drill.robot.go_back(0.5), 0.2, Drill.trust, "the observation went back in time by"),
    "out of range": (lambda drill: drill.planner.exceed(), 0.2, Drill.trust, "the plan is out of range: base/x = 5"),
}


@pytest.fixture(scope="module")
def drill():
    scene = make_scene(
        plant={"randomize": False},
        engine={"threads": 1},
        goal={"frame": "base/centre", "position": (50.0, 0.0)},
        timing={"control_dt": 0.04, "timeout": 60.0},
    )
    with PlannerProcess(scene, speed=SPEED, engine="mujoco", device="cpu") as process:
        yield Drill(scene, process)


@pytest.mark.parametrize("name", FAULTS)
def test_every_fault_brings_the_safe_command_soon_and_one_line_and_is_recovered_from(drill, name, caplog):
    fail, lasts, mend, says = FAULTS[name]
    drill.run(until=lambda: drill.loop.agent.following and drill.robot.plant.state.joint_qd[0] > 0.5)  # on its way
    begin, before = drill.now, len(drill.loop.agent.faults)
    with caplog.at_level(logging.WARNING, "warpmpc"):
        fail(drill)
        drill.run_for(lasts)
        sent = [(moment, control) for moment, control in drill.robot.sent if begin <= moment < drill.now]
        mend(drill)
        drill.run(until=lambda: drill.loop.agent.following)
        drill.run_for(0.6)  # it stays so
    moving = [moment for moment, control in sent if control.any()]
    assert max(moving, default=begin) + 1.0 / drill.loop.scene.agent.rate - begin <= SOON
    assert not sent[-1][1].any()  # zero velocity is safe for this drive
    lines = [line for line in caplog.messages if "process died" not in line]
    assert len(lines) == 2, lines
    assert says in lines[0]
    assert lines[0].endswith("sending the safe command")
    assert "following the plan again" in lines[1]
    assert len(drill.loop.agent.faults) == before + 1
    times = [moment for moment, _ in drill.robot.sent if moment >= begin]
    np.testing.assert_allclose(np.diff(times)[np.diff(times) > 0.0], 1.0 / drill.loop.scene.agent.rate)  # all ticks
