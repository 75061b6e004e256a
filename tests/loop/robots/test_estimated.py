# SPDX-License-Identifier: Apache-2.0
"""States with estimated poses where poses and clocks are not what they should be."""

from dataclasses import replace

import numpy as np
import pytest
from estimated_dog import dog
from small_scenes import BOX, compiled, make_scene

from warpmpc import State
from warpmpc.loop.estimation.base_estimator import LONGEST as LONGEST_BASE
from warpmpc.loop.estimation.base_filter import BaseFilter
from warpmpc.loop.estimation.measurement import ImuMeasured, JointsMeasured, PoseMeasured
from warpmpc.loop.estimation.scene_estimator import LONGEST
from warpmpc.loop.robots.drivers import make_robot
from warpmpc.loop.robots.estimated import EstimatedRobot
from warpmpc.scene.model.compiled import compile_scene
from warpmpc.scene.schema_estimate import Estimate, EstimateBase

SCENE = make_scene(object=[BOX]).model_copy(update={"estimate": {"box": Estimate(gate=None)}})


class Driver:
    """A robot whose state and measurements are what a test says."""

    def __init__(self):
        self.state, self.told = None, []

    def observe(self):
        return self.state

    def measurements(self):
        told, self.told = self.told, []
        return told


@pytest.fixture
def driver():
    return Driver()


@pytest.fixture
def robot(driver):
    return EstimatedRobot(driver, SCENE, compiled(SCENE))


def pose(time: float, x: float = 0.5) -> PoseMeasured:
    return PoseMeasured("box", time, np.array([x, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0]))


def seen(robot, driver, time: float, *told: PoseMeasured) -> State | None:
    driver.state, driver.told = replace(State.start(compiled(SCENE).layout), time=time), list(told)
    return robot.observe()


def box_x(state: State) -> float:
    return float(state.joint_q[-7])


@pytest.mark.parametrize(
    ("measures", "unused"), [(True, ["estimate_base.base"]), (False, ["estimate_base.base", "estimate.box"])]
)
def test_what_a_driver_does_not_measure_is_warned_of(monkeypatch, caplog, measures, unused):
    made = Driver() if measures else object()
    monkeypatch.setattr("warpmpc.loop.robots.drivers.find_driver", lambda choice: lambda scene, **keys: made)
    scene = SCENE.model_copy(update={"estimate_base": {"base": EstimateBase(feet=["base/tip"])}})
    robot = make_robot("mine", scene, compiled=compiled(SCENE))
    assert isinstance(robot, EstimatedRobot) == measures
    assert caplog.messages == [f"{', '.join(unused)}: not used: the robot 'mine' does not measure what it needs"]
    caplog.clear()
    make_robot("mine", make_scene(), compiled=compiled(SCENE))
    assert not caplog.messages


@pytest.mark.parametrize(
    "wrong",
    [{"pose": np.full(7, np.nan)}, {"pose": np.zeros(7)}, {"time": np.nan}, {"time": np.inf}, {"time": -np.inf}],
)
def test_poses_that_are_none_do_not_make_a_state_fresh(robot, driver, wrong):
    assert seen(robot, driver, 5.0, replace(pose(5.0), **wrong)) is None
    assert "a pose is" in robot.heard()[-1].missing
    assert seen(robot, driver, 5.0, pose(5.0)).time == 5.0
    for time in (5.1, 5.2, 5.5):
        state = seen(robot, driver, time, replace(pose(time), **wrong))
    assert state.time == 5.0 + LONGEST
    assert box_x(state) == pytest.approx(0.5)


def test_an_overtaken_pose_does_not_make_a_state_older(robot, driver):
    seen(robot, driver, 5.2, pose(5.2))
    assert seen(robot, driver, 5.4, pose(5.0)).time == 5.4
    assert robot.heard()[-1].stamp == 5.2


def test_a_pose_from_far_ahead_is_refused_and_those_before_it_stay(robot, driver):
    seen(robot, driver, 5.0, pose(5.0))
    seen(robot, driver, 5.1, pose(500.0, 3.0))
    heard = robot.heard()[-1]
    assert (heard.refused, heard.stamp) == (1, 5.0)
    assert "494.900 s ahead of the robot's state" in heard.problem
    state = seen(robot, driver, 5.2, pose(5.2, 0.6))
    assert state.time == 5.2
    assert box_x(state) == pytest.approx(0.6, abs=0.03)


def test_after_a_clock_was_set_back_poses_count_anew(robot, driver):
    for k in range(30):
        seen(robot, driver, 100.0 + k / 30, pose(100.0 + k / 30))
    assert seen(robot, driver, 1.0, pose(101.0)) is None  # one from before
    for k in range(10):
        state = seen(robot, driver, 1.1 + k / 30, pose(1.1 + k / 30, 0.9))
    assert state.time == 1.1 + 9 / 30
    assert box_x(state) == pytest.approx(0.9, abs=0.01)


def test_a_state_without_a_time_is_for_the_watchdog_to_see(robot, driver):
    assert seen(robot, driver, np.nan) is None
    seen(robot, driver, 5.0, pose(5.0))
    assert np.isnan(seen(robot, driver, np.nan, pose(5.1)).time)
    assert seen(robot, driver, 5.2).time == 5.2


class Walker(Driver):
    """A quadruped that stands still and says what a test says."""

    measures = (PoseMeasured, ImuMeasured, JointsMeasured)

    def __init__(self, layout):
        super().__init__()
        self.start, self.sent = State.start(layout), 0

    def apply(self, control):
        self.sent += 1

    def stand(self, *times):
        """Be at the last of some times [s], and measure at all of them."""
        q = self.start.joint_q[7:]
        for moment in times:
            self.told += [
                ImuMeasured("dog", moment, np.zeros(3), np.array([0.0, 0.0, 9.81])),
                JointsMeasured("dog", moment, q, np.zeros(12), np.zeros(12)),
            ]
        self.state = replace(self.start, time=times[-1])


@pytest.fixture
def walker():
    """A quadruped, and what estimates its base."""
    scene = dog()
    driver = Walker(compile_scene(scene).layout)
    return driver, EstimatedRobot(driver, scene, compile_scene(scene))


def test_a_unit_far_ahead_is_refused_and_changes_nothing(walker):
    driver, robot = walker
    driver.stand(20.0, 20.05)
    robot.observe()
    robot.apply(np.zeros(12))
    for wrong in (500.0, np.inf, np.nan):
        driver.stand(20.1)
        driver.told.append(ImuMeasured("dog", wrong, np.zeros(3), np.array([0.0, 0.0, 9.81])))
        assert robot.observe().time == pytest.approx(20.1)
    assert not robot.done
    assert "ahead" in robot.heard()[0].problem or "finite" in robot.heard()[0].problem


def test_a_driver_may_use_the_arrays_of_its_measurements_again(walker):
    driver, robot = walker
    gyro, accel = np.zeros(3), np.array([0.0, 0.0, 9.81])
    for k in range(60):
        gyro[:] = [35.0, 0.0, 0.0] if k == 40 else 0.0  # one bad sample is left out, for it jumps
        driver.stand(0.002 * k)
        driver.told[0] = ImuMeasured("dog", 0.002 * k, gyro, accel)
        seen = robot.observe()
    np.testing.assert_allclose(seen.joint_qd[:6], driver.start.joint_qd[:6], atol=0.02)


def test_poses_that_come_late_are_filtered_with_those_that_were_measured(robot, driver):
    numbers = pose(0.0).pose
    for k in range(20):
        numbers[0] = 0.05 * k
        seen(robot, driver, 0.1 * k, replace(pose(0.1 * k), pose=numbers))
    state = seen(robot, driver, 1.95, pose(1.35, 0.675))  # those after it are taken in again
    np.testing.assert_allclose(state.joint_qd[-6:-3], [0.5, 0.0, 0.0], atol=0.05)


def commanded(walker):
    """The driver and the robot after a first command, with what was measured since."""
    driver, robot = walker
    driver.stand(20.0, 20.05)
    robot.observe()
    robot.apply(np.zeros(12))
    driver.stand(20.1)
    return driver, robot


@pytest.mark.parametrize("seconds", [2.0, 100.0, -2.0, -100.0])
def test_one_state_with_a_wrong_time_ends_no_run(walker, seconds):
    driver, robot = commanded(walker)
    driver.state = replace(driver.state, time=20.1 + seconds)
    robot.observe()
    driver.stand(20.15)
    assert robot.observe().time == pytest.approx(20.15)
    assert not robot.done


def test_a_unit_of_long_ago_ends_no_run(walker):
    driver, robot = commanded(walker)
    driver.told.append(ImuMeasured("dog", 3.0, np.zeros(3), np.array([0.0, 0.0, 9.81])))
    assert robot.observe().time == pytest.approx(20.1)
    assert not robot.done


def test_a_gap_between_measurements_that_come_together_is_seen(walker):
    driver, robot = walker
    driver.stand(20.0, 20.05)
    robot.observe()
    robot.apply(np.zeros(12))
    driver.stand(20.1, 24.0)
    assert robot.observe().time == pytest.approx(20.05)
    assert robot.done


def test_a_clock_that_is_set_back_ends_the_run_of_a_base_that_was_commanded(walker, caplog):
    driver, robot = walker
    driver.stand(20.0, 20.05)
    robot.observe()
    driver.stand(5.0, 5.05)
    assert robot.observe().time == pytest.approx(5.05), "it was not commanded yet"
    robot.apply(np.zeros(12))
    driver.stand(1.0, 1.05)
    assert robot.observe().time == pytest.approx(5.05)
    assert robot.done
    assert "the clock was set back" in caplog.text


def test_a_unit_and_joints_that_waited_take_a_moment(walker, monkeypatch):
    driver, robot = walker
    driver.stand(20.0)
    robot.observe()
    steps = []
    for name in ("propagate", "correct"):
        true = getattr(BaseFilter, name)
        monkeypatch.setattr(BaseFilter, name, lambda *args, true=true: steps.append(1) or true(*args))
    driver.stand(*np.arange(20.0025, 20.4, 0.0025))  # as after a pause of the loop
    driver.told.sort(key=lambda measured: measured.order)  # by their topics
    robot.observe()
    assert len(steps) < 60
    for moment in np.arange(20.405, 20.6, 0.005):
        steps.clear()
        driver.stand(moment)
        late = driver.told[0]
        driver.told += [replace(late, time=moment - 0.3), replace(late, time=moment - 0.7)]
        seen = robot.observe()
        assert len(steps) < 60
    assert seen.time == driver.state.time
    np.testing.assert_allclose(seen.joint_q[:7], driver.start.joint_q[:7], atol=0.02)


def test_two_things_are_estimated_again_after_the_clock_was_set_back(driver):
    boxes = [BOX, BOX | {"name": "other", "position": (0.0, 2.0, 0.3)}]
    scene = make_scene(object=boxes).model_copy(
        update={"estimate": {name: Estimate(gate=None) for name in ("box", "other")}}
    )
    robot = EstimatedRobot(driver, scene, compiled(scene))
    start = State.start(compiled(scene).layout)

    def tick(time, name):
        driver.state, driver.told = replace(start, time=time), [replace(pose(time), name=name)]
        return robot.observe()

    tick(100.0, "box")
    assert tick(100.01, "other") is not None
    tick(1.0, "box")
    assert tick(1.01, "other").time == pytest.approx(1.01)


def test_a_unit_that_was_silent_begins_anew_before_the_first_command_alone(walker, caplog):
    driver, robot = walker

    def height():
        return float(robot.observe().joint_q[2])

    driver.state = replace(driver.start, time=0.0)
    assert robot.observe() is None, "nothing was measured"
    start = float(driver.start.joint_q[2])
    driver.stand(0.0, 0.05)
    assert height() == pytest.approx(start, abs=0.01)
    driver.stand(20.0, 20.05)  # as long as a planner takes to start
    assert height() == pytest.approx(start, abs=0.01)
    assert robot.observe().time == pytest.approx(20.05)
    driver.state = replace(driver.start, time=20.5)
    assert robot.observe().time <= 20.05 + LONGEST_BASE + 1e-6, "the watchdog sees that it is old"
    driver.stand(20.55, 20.6)
    assert robot.observe().time == pytest.approx(20.6)
    robot.apply(np.zeros(12))
    driver.stand(23.0, 23.05)
    assert robot.observe().time == pytest.approx(20.6)
    assert "the unit or joints of dog were silent" in caplog.text
    assert robot.done
    driver.stand(23.1, 23.15)
    assert robot.observe().time == pytest.approx(20.6), "nobody knows where it is"
    assert driver.sent == 1
