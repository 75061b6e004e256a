# SPDX-License-Identifier: Apache-2.0
"""The fault drill: whatever goes wrong, the safe command within 100 ms, a log line, and back by itself."""

import gc
import logging
from dataclasses import replace

import numpy as np
import pytest
from drills import MOVE, Scripted, drill, ticks
from faulty_robots import FaultyRobot
from small_scenes import DISC, compiled, layout_of, make_scene

from warpmpc import Plan, RobotLoop, SceneError, State, simulated_robot
from warpmpc.loop.realtime.agent import Agent
from warpmpc.loop.realtime.messages import TimedPlan
from warpmpc.scene.schema import SplineKind

SOON = 0.1
"""Within this time after a fault the robot has the safe command [s]."""


def stall(robot, planner) -> None:
    planner.stalled = True


def diverge(robot, planner) -> None:
    planner.survived = False


def exceed(robot, planner) -> None:
    planner.control = np.array([5.0, 0.0, 0.0], dtype=np.float32)


def lose_numbers(robot, planner) -> None:
    planner.control = np.array([np.nan, 0.0, 0.0], dtype=np.float32)


def mend(robot, planner) -> None:
    planner.stalled, planner.survived, planner.control, robot.spoil = False, True, MOVE, None


FAULTS = {
    "stalled": (stall, "the newest plan is from what was observed 0.09"),
    "diverged": (diverge, "every rollout diverged"),
    "out of range": (exceed, "the plan is out of range: base/x = 5"),
    "plan not finite": (lose_numbers, "the plan is not finite"),
    "not finite": (lambda robot, _: robot.forget_numbers(), "the observation is not finite"),
    "frozen": (lambda robot, _: robot.freeze(), "the observation is 0.05"),
    "joints frozen": (lambda robot, _: robot.freeze_joints(), "the observation is frozen"),
    "back in time": (lambda robot, _: robot.go_back(0.5), "the observation went back in time by 0.4"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_every_fault_gets_the_safe_command_in_time_and_is_recovered_from(name, caplog):
    fail, why = FAULTS[name]
    loop, robot, planner = drill()
    begin = robot.plant.time
    assert np.abs(robot.plant.state.joint_qd).max() > 0.3  # it moves
    with caplog.at_level(logging.WARNING):
        fail(robot, planner)
        ticks(loop, 500)  # a second
    unsafe = [time for time, control in robot.sent if time >= begin and control.any()]
    assert max(unsafe, default=begin) - begin + 1.0 / loop.scene.agent.rate <= SOON
    assert len(caplog.messages) == 1
    assert why in caplog.messages[0]
    assert caplog.messages[0].endswith("sending the safe command")
    assert np.abs(robot.plant.state.joint_qd).max() < 0.02  # zero velocity, and it stands
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        mend(robot, planner)
        ticks(loop, 300)
    assert loop.agent.following
    assert loop.agent.fault is None
    assert len(loop.agent.faults) == 1
    assert "following the plan again" in caplog.messages[0]
    np.testing.assert_allclose(robot.sent[-1][1], MOVE)


def test_positions_are_held_where_the_robot_was_when_the_fault_began():
    drive = {"mode": "position", "stiffness": 900.0, "damping": 60.0, "lower": (-2.0,) * 3, "upper": (2.0,) * 3}
    loop, robot, planner = drill(robot=[DISC | {"drive": drive}])
    robot.forget_numbers()
    was = planner.observations[-1].state.joint_q
    ticks(loop, 200)
    sent = np.array([control for _, control in robot.sent[-200:]])
    np.testing.assert_allclose(sent, np.tile(sent[0], (200, 1)))
    np.testing.assert_allclose(sent[0], was)


def test_accelerations_brake_and_then_keep_still():
    drive = {"mode": "acceleration", "damping": 300.0, "limit": 20.0, "speed_limit": 1.0}
    loop, robot, planner = drill(robot=[DISC | {"drive": drive}])
    planner.stalled = True
    ticks(loop, 250)
    assert np.abs(robot.plant.state.joint_qd).max() < 0.02


def test_the_planner_hears_of_no_observation_that_cannot_be_trusted():
    loop, robot, planner = drill()
    seen = len(planner.observations)
    robot.forget_numbers()
    ticks(loop, 100)
    assert len(planner.observations) == seen


def test_before_the_first_plan_the_robot_stands_and_that_is_no_fault(caplog):
    scene = make_scene()
    robot, planner = FaultyRobot(simulated_robot(scene, compiled=compiled(scene))), Scripted()
    planner.stalled = True
    loop = RobotLoop(scene, robot, planner, simulated=True, agent=Agent(scene, layout_of(scene)))
    ticks(loop, 200)
    assert not any(control.any() for _, control in robot.sent)
    assert len(robot.sent) == 200
    assert not loop.agent.faults
    assert not caplog.messages


def test_nothing_is_sent_where_there_is_no_position_to_hold():
    drive = {"mode": "position", "stiffness": 900.0, "damping": 60.0, "lower": (-2.0,) * 3, "upper": (2.0,) * 3}
    scene = make_scene(robot=[DISC | {"drive": drive}])
    agent = Agent(scene, layout_of(scene))
    state = State(np.full(3, np.nan), np.zeros(3), time=0.0)
    assert agent.command(state, None, 0.0) is None


@pytest.mark.parametrize("slew", [2.0, (2.0, 4.0, 1.0)])
def test_controls_change_no_faster_than_the_slew_whatever_is_planned_and_when_it_fails(slew):
    loop, robot, planner = drill(agent={"slew": slew})
    for control in ([1.0, 1.0, 1.0], [-1.0, 1.0, -1.0]):
        planner.control = np.array(control, dtype=np.float32)
        ticks(loop, 100)
    planner.stalled = True
    ticks(loop, 400)
    sent = np.array([control for _, control in robot.sent])
    rate = np.abs(np.diff(sent, axis=0)).max(axis=0) * loop.scene.agent.rate
    np.testing.assert_allclose(rate, np.broadcast_to(slew, 3), rtol=1e-3)  # all of it is used
    assert not sent[-1].any()


def test_a_slew_of_the_wrong_length_is_refused_by_its_key():
    scene = make_scene(agent={"slew": (1.0, 2.0)})
    with pytest.raises(SceneError, match=r"agent\.slew.*one value or 3"):
        Agent(scene, layout_of(scene))


def test_a_plan_that_is_replaced_is_followed_from_its_own_times():
    scene = make_scene()
    agent = Agent(scene, layout_of(scene))
    limits = np.full(3, -1.0), np.full(3, 1.0)
    plan = Plan(np.array([[0.0] * 3, [0.4] * 3]), np.array([2.0, 2.4]), SplineKind.LINEAR, *limits)
    timed = TimedPlan(plan, 0, 1.98, 0.02, 10.0, True)
    state = State(np.zeros(3), np.zeros(3), time=2.0)
    np.testing.assert_allclose(agent.command(state, timed, 2.0), 0.0)
    later = replace(state, joint_q=np.full(3, 0.1), time=2.06)
    np.testing.assert_allclose(agent.command(later, timed, 2.06), 0.06, atol=1e-6)


@pytest.mark.parametrize("stall", [0.3, 2.0])
def test_a_plan_from_before_a_stall_is_not_followed_whether_it_is_over_or_not(stall, caplog):
    loop, robot, planner = drill()
    observation, planner.stalled = planner.observations[-1], True
    ticks(loop, round(stall * loop.scene.agent.rate))  # over a plan for the second after the observation
    before, begin = planner.newest(), robot.plant.time
    plan = replace(before.plan, times=observation.state.time + np.array([0.0, 1.0]))
    late = {"number": before.number + 1, "observed": observation.state.time, "latency": stall}
    planner._timed = replace(before, plan=plan, **late)
    ticks(loop, 20)
    assert not any(control.any() for time, control in robot.sent if time >= begin)
    assert not loop.agent.following
    mend(robot, planner)
    ticks(loop, 300)
    assert loop.agent.following
    assert len(loop.agent.faults) == 1
    assert ["following the plan again" in line for line in caplog.messages] == [False, True]


def test_a_fault_that_comes_and_goes_is_two_lines_and_one_fault_with_a_count(caplog):
    loop, robot, planner = drill()
    begin = robot.plant.time
    for _ in range(20):  # a plan lasts 0.09 s, the next one comes after 0.12 s
        planner.period = 0.12
        ticks(loop, 60)
    loop_fault = loop.agent.faults[0]
    assert [line.endswith("sending the safe command") for line in caplog.messages] == [True]
    planner.period = 0.04
    ticks(loop, 400)
    assert loop.agent.faults == [loop_fault]
    assert 18 <= loop_fault.count <= 20
    assert begin < loop_fault.start < begin + 0.15
    assert loop_fault.end == pytest.approx(begin + 20 * 0.12, abs=0.15)
    assert len(caplog.messages) == 2
    assert f"following the plan again after {loop_fault.end - loop_fault.start:.3f} s" in caplog.messages[1]
    assert caplog.messages[1].endswith(f", {loop_fault.count} times in all")
    planner.stalled = True
    ticks(loop, 60)
    assert len(loop.agent.faults) == 2  # another one


def test_a_robot_that_rests_is_not_taken_for_frozen():
    scene = make_scene()
    agent = Agent(scene, layout_of(scene))
    planner = Scripted(control=np.zeros(3))
    for k in range(200):
        state = State(np.zeros(3), np.zeros(3), time=0.002 * k)
        agent.command(state, planner.newest(), 0.002 * k)
        planner.observe(type("Seen", (), {"state": state}))
    assert not agent.faults


def test_a_loop_that_goes_on_begins_at_once(monkeypatch):
    loop, robot, _ = drill()
    calls = []
    monkeypatch.setattr(gc, "collect", lambda: calls.append(1))
    fresh = RobotLoop(loop.scene, robot, Scripted(), simulated=True, agent=Agent(loop.scene, loop.agent.layout))
    for _ in range(3):
        fresh.run(lambda: True)
    assert len(calls) == 1  # before the first tick, never between two
    assert gc.get_freeze_count() == 0


@pytest.mark.parametrize(
    ("sections", "key"),
    [({"agent": {"slew": 2.0}}, r"agent\.slew"), ({"planner": {"method": "ilqg"}}, r"planner\.refine\.method")],
)
def test_a_driver_that_sends_plans_is_refused_what_plans_cannot_keep(sections, key):
    scene = make_scene(**sections)
    agent, robot = Agent(scene, layout_of(scene)), FaultyRobot(None)
    RobotLoop(scene, robot, None, agent=agent)
    robot.follow = lambda plan, now: None
    with pytest.raises(SceneError, match=key):
        RobotLoop(scene, robot, None, agent=agent)
