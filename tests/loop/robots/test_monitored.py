# SPDX-License-Identifier: Apache-2.0
"""A driver's robot in the loop: what it may leave out, what is called when, and observations that are none."""

from dataclasses import replace

import numpy as np
from drills import Scripted
from small_scenes import compiled, layout_of, make_scene

from warpmpc import RobotLoop, RunLog, RunRecorder, State, Task
from warpmpc.loop.realtime.agent import Agent
from warpmpc.loop.realtime.watchdog import FaultKind
from warpmpc.loop.robots.estimated import MonitoredRobot

SCENE = make_scene(goal={"frame": "base/centre", "position": (0.3, 0.0)}, success={"distance": 0.05})


class Driver:
    """A robot that is where it is told to be, and notes what it is told."""

    def __init__(self):
        self.state: State | None = None
        self.told: list[str] = []

    def observe(self):
        return self.state

    def apply(self, control):
        self.told.append("apply" if control.any() else "safe")

    def stop(self):
        self.told.append("stop")


class Follower(Driver):
    """A robot that takes plans."""

    def follow(self, plan, now):
        assert plan.times[0] <= now <= plan.times[-1]
        self.told.append("follow")


def at(x: float, time: float) -> State:
    state = replace(State.start(layout_of(SCENE)), time=time)
    state.joint_q[0] = x
    return state


def looped(driver) -> tuple[MonitoredRobot, RobotLoop]:
    robot = MonitoredRobot(SCENE, driver, task=Task(SCENE), compiled=compiled(SCENE))
    return robot, loop_of(robot)


def loop_of(robot: MonitoredRobot, **kwargs) -> RobotLoop:
    return RobotLoop(SCENE, robot, Scripted(), simulated=True, agent=Agent(SCENE, layout_of(SCENE)), **kwargs)


def ticks(loop: RobotLoop, driver: Driver, first: float, count: int, x: float = 0.0) -> None:
    for tick in range(count):
        driver.state = at(x + 1e-4 * tick, first + 0.002 * tick)
        loop.tick()
        loop.pace._tick += 1


def test_nothing_is_sent_before_the_first_state_and_stop_comes_after_the_last_safe_command():
    driver = Driver()
    robot, loop = looped(driver)
    for _ in range(3):
        assert loop.tick() is None
    assert (driver.told, robot.done) == ([], False)
    ticks(loop, driver, 5.0, 5)
    assert driver.told[-3:] == ["apply"] * 3
    loop.run(lambda: True)
    assert driver.told[-2:] == ["safe", "stop"]


def test_a_robot_that_shows_nothing_any_more_gets_the_safe_command():
    driver = Driver()
    _, loop = looped(driver)
    ticks(loop, driver, 5.0, 5)
    assert driver.told[-1] == "apply"
    driver.state, driver.observe = None, lambda: None
    for _ in range(round((SCENE.agent.observation_timeout + 0.01) * SCENE.agent.rate)):
        loop.tick()
        loop.pace._tick += 1
    assert driver.told[-1] == "safe"
    assert loop.agent.fault.kind is FaultKind.OBSERVATION_OLD


def test_plans_are_handed_over_while_they_are_followed_and_safe_commands_are_applied():
    driver = Follower()
    _, loop = looped(driver)
    ticks(loop, driver, 5.0, 5)
    assert driver.told[-3:] == ["follow"] * 3
    loop.planner.survived = False
    ticks(loop, driver, 5.05, 5)
    assert driver.told[-1] == "safe"


def test_the_end_is_found_in_what_is_observed_and_numbers_that_are_none_do_not_end_the_run():
    driver = Driver()
    robot, _ = looped(driver)
    driver.state = at(0.0, 5.0)
    robot.observe()
    good = robot.state
    for wrong in (
        replace(good, joint_q=np.zeros(2)),
        replace(good, joint_q=good.joint_q * np.nan, time=5.1),
        replace(good, time=np.nan),
        replace(good, mocap=np.zeros((2, 7))),
    ):
        driver.state = wrong
        assert robot.observe() is not None
        np.testing.assert_array_equal(robot.state.joint_q, good.joint_q)
        assert not robot.done
    driver.state = at(0.28, 5.5)
    robot.observe()
    assert (robot.success, robot.reason, robot.time) == (True, "goal reached", 0.5)
    centre = layout_of(SCENE).body_name.index("base/base_link")
    np.testing.assert_allclose(robot.body_q[centre, 0], 0.28, atol=1e-6)
    assert robot.error.position < 0.05


def test_a_log_has_each_command_in_the_state_that_it_was_sent_in(tmp_path):
    driver = Driver()
    robot = MonitoredRobot(SCENE, driver, task=Task(SCENE), compiled=compiled(SCENE))
    driver.state = at(0.0, 5.0)
    robot.observe()
    recorder = RunRecorder(robot, path=tmp_path / "run.runlog")
    ticks(loop_of(robot, recorder=recorder), driver, 5.0, 6)
    recorder.close()
    log = RunLog.load(tmp_path / "run.runlog")
    assert len(log.controls) == 5  # the sixth has no state after it
    np.testing.assert_array_equal(log.states.joint_q[:-1], log.controls.seen_q)
    np.testing.assert_array_equal(log.states.time[:-1], log.controls.seen_time)
    assert log.states.time[-1] == 5.01


def test_a_run_whose_robot_is_gone_ends_at_its_timeout(monkeypatch):
    driver, clock = Driver(), [100.0]
    monkeypatch.setattr("warpmpc.loop.robots.estimated.time.monotonic", lambda: clock[0])
    robot, _ = looped(driver)
    driver.state = at(0.0, 3.0)
    for _ in range(5):
        robot.observe()
        assert not robot.done
        clock[0] += 0.2 * SCENE.timing.timeout
    clock[0] += 3.0
    robot.observe()
    assert robot.done
    assert robot.reason == "timeout"
    assert not robot.success
