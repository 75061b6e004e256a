# SPDX-License-Identifier: Apache-2.0
"""Whatever a driver shows and a planner sends, nothing unsafe is sent and the loop goes on: drills in closed loop."""

import logging
from dataclasses import replace

import numpy as np
import pytest
from drills import MOVE, Scripted, drill, ticks
from faulty_robots import FaultyRobot
from small_scenes import DISC, compiled, layout_of, make_scene

from warpmpc import RobotLoop, RunRecorder, State, simulated_robot
from warpmpc.loop.realtime import pace
from warpmpc.loop.realtime.agent import Agent
from warpmpc.loop.realtime.pace import RobotClock
from warpmpc.loop.realtime.watchdog import FaultKind
from warpmpc.planner.feedback import Feedback, StateSpace
from warpmpc.scene.schema import SplineKind

HOUR = 3600.0
POSITION = {"mode": "position", "stiffness": 900.0, "damping": 60.0, "lower": (-2.0,) * 3, "upper": (2.0,) * 3}


def test_a_robot_whose_driver_uses_its_arrays_again_is_held_where_it_was_and_not_where_it_is_dragged_to():
    loop, robot, planner = drill(robot=[DISC | {"drive": POSITION}])
    robot.reuse_arrays()
    planner.stalled = True
    ticks(loop, 60)
    was = next(observation.state for observation in planner.observations[40:] if not observation.following)
    held = robot.sent[-1][1]
    np.testing.assert_array_equal(held, was.joint_q)
    seen = robot.spoil
    drag = np.linspace(0.0, 0.2, 250)
    robot.spoil = lambda state: seen(replace(state, joint_q=state.joint_q + drag[min(len(robot.sent) - begin, 249)]))
    begin = len(robot.sent)
    ticks(loop, 250)
    np.testing.assert_array_equal([control for _, control in robot.sent[begin:]], np.tile(held, (250, 1)))
    assert robot.spoil(robot.plant.observe()).joint_q[0] - held[0] > 0.1  # it was dragged


def test_a_driver_that_uses_its_arrays_again_is_not_taken_for_frozen_and_spoils_no_sighting():
    loop, robot, planner = drill()
    robot.reuse_arrays()
    ticks(loop, 500)
    assert not loop.agent.faults
    places = [observation.state.joint_q[0] for observation in planner.observations[-400:]]
    assert (np.diff(places) > 0.0).all()  # each is what it was


def test_a_driver_that_changes_the_control_that_it_is_given_changes_nobody_elses():
    loop, robot, planner = drill(agent={"slew": 2.0})
    apply, begin = robot.apply, len(robot.sent)

    def scaled(control: np.ndarray) -> None:
        apply(control)
        control *= 1000.0  # to the robot's own unit

    robot.apply = scaled
    ticks(loop, 50)
    for observation, (_, control) in zip(planner.observations[-40:], robot.sent[-41:], strict=False):
        np.testing.assert_array_equal(observation.command, control)
    planner.stalled = True
    ticks(loop, 500)
    loop._stop()
    steps = np.abs(np.diff([control for _, control in robot.sent[begin:]], axis=0))
    assert steps.max() <= 2.0 / loop.scene.agent.rate + 1e-6


def jump(robot: FaultyRobot, seconds: float) -> None:
    robot.spoil = lambda state: replace(state, time=state.time + seconds)


def test_one_observation_from_the_future_is_one_bad_tick(caplog):
    loop, robot, planner = drill()
    jump(robot, HOUR)
    ticks(loop, 1)
    assert not robot.sent[-1][1].any()
    assert loop.agent.fault.kind is FaultKind.OBSERVATION_AHEAD
    assert planner.observations[-1].state.time < 1.0  # the planner does not hear of it
    robot.spoil = None
    ticks(loop, 1)
    assert loop.agent.following
    ticks(loop, 300)
    assert loop.agent.following
    assert loop.now == pytest.approx(robot.plant.time, abs=0.01)
    assert [line.split(": ")[1] for line in caplog.messages] == [
        "the observation is 3600.000 s ahead of the clock; sending the safe command",
        "following the plan again after 0.002 s",
    ]


@pytest.mark.parametrize(("seconds", "unsafe"), [(0.9, 1), (0.5, 1), (0.06, 1), (0.02, 10)])
def test_one_observation_a_little_ahead_of_the_clock_is_one_bad_tick_too(seconds, unsafe):
    loop, robot, _ = drill()
    begin = len(robot.sent)
    jump(robot, seconds)
    ticks(loop, 1)
    robot.spoil = None
    ticks(loop, 300)
    assert sum(not control.any() for _, control in robot.sent[begin:]) <= unsafe


def test_states_that_come_with_less_delay_are_soon_believed():
    loop, robot, _ = drill()
    jump(robot, 0.2)
    begin = len(robot.sent)
    ticks(loop, 300)
    assert sum(not control.any() for _, control in robot.sent[begin:]) <= 60
    assert loop.now == pytest.approx(robot.plant.time + 0.2, abs=0.01)


def test_a_tick_that_is_late_takes_no_observation_for_one_from_the_future(monkeypatch):
    class Wall:
        now, late = 100.0, 0.0

        def monotonic(self) -> float:
            return self.now

        def sleep(self, seconds: float) -> None:
            self.now += seconds + self.late

    wall = Wall()
    monkeypatch.setattr(pace, "time", wall)
    scene = make_scene(plant={"randomize": False})
    robot, planner = FaultyRobot(simulated_robot(scene, compiled=compiled(scene))), Scripted()
    robot.spoil = lambda state: replace(state, time=wall.now)
    loop = RobotLoop(scene, robot, planner, agent=Agent(scene, layout_of(scene)))
    loop.run(lambda: wall.now >= 101.0)
    wall.late = 0.08
    loop.run(lambda: wall.now >= 101.05)  # one sleep that takes long, as on a machine with much to do
    wall.late = 0.0
    loop.run(lambda: wall.now >= 102.0)
    assert not loop.agent.faults


def test_an_observation_from_the_future_that_stays_is_never_believed():
    loop, robot, _ = drill()
    late = replace(robot.plant.observe(), time=HOUR)
    robot.spoil = lambda _: late
    begin = len(robot.sent)
    ticks(loop, 1500)  # three seconds
    assert not any(control.any() for _, control in robot.sent[begin:])
    robot.spoil = None
    ticks(loop, 2)
    assert loop.agent.following


@pytest.mark.parametrize("seconds", [HOUR, -HOUR])
def test_a_clock_that_was_set_is_believed_after_a_second(seconds):
    loop, robot, _ = drill()
    jump(robot, seconds)
    begin = len(robot.sent)
    ticks(loop, 490)
    assert not any(control.any() for _, control in robot.sent[begin:])
    ticks(loop, 60)
    assert loop.agent.following
    assert loop.now == pytest.approx(robot.plant.time + seconds, abs=0.01)
    ticks(loop, 300)
    assert len(loop.agent.faults) == 1
    assert 0.0 <= loop.agent.faults[0].end - loop.agent.faults[0].start <= HOUR + 2.0


def test_a_first_observation_from_the_future_is_forgotten_after_a_second():
    scene = make_scene(plant={"randomize": False})
    robot, planner = FaultyRobot(simulated_robot(scene, compiled=compiled(scene))), Scripted()
    loop = RobotLoop(scene, robot, planner, simulated=True, agent=Agent(scene, layout_of(scene)))
    jump(robot, HOUR)
    ticks(loop, 1)
    robot.spoil = None
    ticks(loop, 600)
    assert loop.agent.following
    np.testing.assert_allclose(robot.sent[-1][1], MOVE)


def test_times_without_order_set_no_clock():
    clock, rng = RobotClock(), np.random.default_rng(0)
    for k in range(3000):
        tick = 0.002 * k
        clock.see(tick if k < 10 else float(rng.choice([-1.0, 1.0]) * rng.uniform(10.0, HOUR)), tick)
    assert clock.at(6.0) == pytest.approx(6.0)


def test_a_pause_between_two_runs_of_a_real_robot_is_no_jump_of_its_clock(monkeypatch):
    class Wall:
        now = 100.0

        def monotonic(self) -> float:
            return self.now

        def sleep(self, seconds: float) -> None:
            self.now += seconds

    wall = Wall()
    monkeypatch.setattr(pace, "time", wall)
    scene = make_scene(plant={"randomize": False})
    plant = simulated_robot(scene, compiled=compiled(scene))
    robot, planner = FaultyRobot(plant), Scripted()
    robot.spoil = lambda state: replace(state, time=wall.now)
    loop = RobotLoop(scene, robot, planner, agent=Agent(scene, layout_of(scene)))
    for seconds in (0.2, 0.4):
        end = wall.now + seconds
        loop.run(lambda end=end: wall.now >= end)
        wall.now += 10.0
    times = [moment for moment, control in robot.sent if control.any()]
    assert len(times) > 250  # it drove in both
    assert FaultKind.OBSERVATION_AHEAD not in [fault.kind for fault in loop.agent.faults]


def shifted(timed, *, observed: float = 0.0, times: float = 0.0):
    plan = replace(timed.plan, times=timed.plan.times + times)
    return replace(timed, plan=plan, observed=timed.observed + observed)


def gains(gain: float, *, times: float = 0.0):
    """Gives plans feedback about a state that is not the robot's."""

    def give(timed):
        scene = make_scene()
        space, nu = StateSpace.of(compiled(scene)), 3
        moments = timed.observed + times + 0.04 * np.arange(26)[None]
        answer = Feedback(
            moments, np.full((1, 26, space.tangent.width), 3.0), np.full((1, 26, nu, space.tangent.size), gain), space
        )
        return replace(timed, plan=replace(timed.plan, feedback=answer))

    return give


def overshoot(timed):
    """Knots inside the limits, a spline between them that is not."""
    times = timed.observed + np.array([-2.0, -1.0, 0.0, 0.001, 0.2, 1.2])
    knots = np.array([-1.0, -1.0, -1.0, 1.0, 1.0, 1.0])[:, None] * np.ones(3, dtype=np.float32)
    return replace(timed, plan=replace(timed.plan, knots=knots, times=times, spline=SplineKind.CUBIC))


def cut(knots: int, controls: int = 3):
    """Leaves so many knots and controls of a plan."""

    def change(timed):
        plan = timed.plan
        return replace(timed, plan=replace(plan, knots=plan.knots[:knots, :controls].copy(), times=plan.times[:knots]))

    return change


BAD_PLANS = {
    "no knots": (cut(0), "the plan has 0 times and knots [0, 3]"),
    "too few controls": (cut(2, 2), "the plan has 2 times and knots [2, 2]"),
    "gains not finite": (gains(np.nan), "the plan's command is not finite"),
    "times of gains not finite": (gains(1.0, times=np.nan), "the plan's command is not finite"),
    "gains too large": (gains(40.0), "the plan's command is out of range: base/x = "),
    "overshoot": (overshoot, "the plan's command is out of range: base/x = "),
    "observed at no time": (lambda timed: shifted(timed, observed=np.nan), "will be observed in nan"),
    "observed in an hour": (lambda timed: shifted(timed, observed=HOUR), "will be observed in 3"),
    "knots at no time": (lambda timed: shifted(timed, times=np.nan), "the plan is not finite"),
    "knots in an hour": (lambda timed: shifted(timed, times=HOUR), "the plan begins in 3"),
    "knots in half a second": (lambda timed: shifted(timed, times=0.5), "the plan begins in 0."),
}


@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize("name", BAD_PLANS)
def test_a_plan_that_cannot_be_true_is_not_followed(name, caplog):
    spoil, why = BAD_PLANS[name]
    loop, robot, planner = drill()
    planner.spoil = spoil
    begin = len(robot.sent)
    with caplog.at_level(logging.WARNING):
        ticks(loop, 250)
    assert not any(control.any() for _, control in robot.sent[begin:])
    assert np.abs(robot.plant.state.joint_qd).max() < 0.02
    assert loop.agent.faults[0].kind is FaultKind.PLAN_INVALID
    assert why in caplog.messages[0]
    planner.spoil = None
    ticks(loop, 1)
    assert loop.agent.following
    np.testing.assert_allclose(robot.sent[-1][1], MOVE)


def test_a_plan_that_came_sooner_than_expected_begins_a_little_later_and_is_followed():
    loop, _, planner = drill()
    planner.spoil = lambda timed: shifted(timed, times=0.02)
    ticks(loop, 100)
    assert not loop.agent.faults


BAD_OBSERVATIONS = {
    "act": lambda state: replace(state, act=np.zeros(7)),
    "mocap": lambda state: replace(state, mocap=np.zeros((2, 7))),
    "no time": lambda state: replace(state, time=None),
    "times": lambda state: replace(state, time=np.zeros(3)),
    "time in words": lambda state: replace(state, time="now"),
    "too few": lambda state: replace(state, joint_q=state.joint_q[:2]),
    "none": lambda state: replace(state, joint_q=None),
    "ragged": lambda state: replace(state, joint_qd=[[0.0], [0.0, 1.0], 0.0]),
    "words": lambda state: replace(state, joint_q=["left", "right", "up"]),
    "words about mocap": lambda state: replace(state, mocap="nowhere"),
}


@pytest.mark.parametrize("name", BAD_OBSERVATIONS)
def test_an_observation_of_a_wrong_kind_is_the_documented_fault(name):
    loop, robot, planner = drill()
    recorder = loop._recorder = RunRecorder(robot.plant)
    robot.spoil = BAD_OBSERVATIONS[name]
    begin, heard = len(robot.sent), len(planner.observations)
    ticks(loop, 250)
    assert len(planner.observations) == heard
    assert not any(control.any() for _, control in robot.sent[begin:])
    assert np.abs(robot.plant.state.joint_qd).max() < 0.02
    assert loop.agent.faults[0].kind is FaultKind.OBSERVATION_INVALID
    robot.spoil = None
    ticks(loop, 50)
    assert loop.agent.following
    controls = recorder.run_log.controls
    assert len(controls) == 300
    assert controls.following.sum() == pytest.approx(50, abs=3)


def test_a_time_in_an_array_of_one_is_a_time():
    loop, robot, _ = drill()
    robot.spoil = lambda state: State(state.joint_q, state.joint_qd, time=np.array([state.time]))
    ticks(loop, 100)
    assert not loop.agent.faults
