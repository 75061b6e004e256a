# SPDX-License-Identifier: Apache-2.0
"""The ROS 2 driver: commands, diagnostics and many messages at once, over real ROS 2 in this process."""

import itertools
import time

import numpy as np
import pytest
from needs import needs
from ros2_wire import JOINTS, TWIST, commanded, joint_state, meet, random_state, until, wired

from warpmpc import Plan, State
from warpmpc.loop.realtime.messages import TimedPlan
from warpmpc.planner.splines import SplineKind

pytestmark = needs("rclpy")


@pytest.fixture
def wire():
    """What makes drivers, robots' ends and nodes that hear no other test."""
    with wired() as made:
        yield made


@pytest.mark.parametrize("spline", SplineKind)
def test_a_trajectory_is_the_plan_at_every_time(wire, spline):
    keys = {"command": {"type": "trajectory_msgs/JointTrajectory"}}
    driver, robot = wire.driver(**keys), wire.robot(**keys)
    moment = itertools.count()
    meet(driver, lambda: robot.publish(random_state(wire.layout, 0, 0.01 * next(moment))))
    rng, now = np.random.default_rng(0), driver.observe().time
    limits = wire.layout.control_lower, wire.layout.control_upper
    knots = rng.uniform(-1.0, 1.0, size=(6, 3)).astype(np.float32)
    plan = Plan(knots, now + 0.4 * np.arange(6.0), spline, *limits)
    offset = 0.01 * (next(moment) - 1) - now  # the driver counts from the first stamp's second
    begin = now + 0.01

    def followed():
        nonlocal begin
        begin += 0.04
        driver.follow(plan, begin)
        return list(robot.receive(0.0))

    command = until(followed)[-1]
    driver.follow(plan, begin + 0.002)  # not sent again
    time.sleep(0.05)
    assert not list(robot.receive(0.0))
    curved = spline in (SplineKind.CUBIC, SplineKind.BSPLINE)
    for at in np.linspace(begin, plan.times[-1], 37)[:-1]:
        np.testing.assert_allclose(command.at(at + offset), plan.at(at), atol=0.03 if curved else 1e-5)
    driver.apply(np.zeros(3, dtype=np.float32))
    (stop,) = until(lambda: list(robot.receive(0.0)))
    np.testing.assert_array_equal(stop.at(now + offset + 1.0), np.zeros(3))


@pytest.mark.parametrize("kind", ["geometry_msgs/Twist", "geometry_msgs/TwistStamped"])
def test_a_twist_is_along_the_axes_of_the_base(wire, kind):
    driver, robot = wire.driver(command={"type": kind, "heading": "base/yaw"}), wire.robot(command={"type": kind})
    state = random_state(wire.layout, 0, 0.0)
    state.joint_q[2] = np.pi / 2.0  # it looks along the world's y
    moment = itertools.count()
    meet(driver, lambda: robot.publish(State(state.joint_q, state.joint_qd, time=0.01 * next(moment))))
    command = commanded(driver, robot, [0.1, 0.7, 0.3])
    np.testing.assert_allclose(command.control, [0.7, -0.1, 0.3], atol=1e-6)


def test_the_safe_command_is_one_without_a_heading(wire):
    driver, robot = wire.driver(command={"type": TWIST, "heading": "base/yaw"}), wire.robot(command={"type": TWIST})
    state = random_state(wire.layout, 0, 0.0)
    moment = itertools.count()
    meet(driver, lambda: robot.publish(State(state.joint_q, state.joint_qd, time=0.01 * next(moment))))
    state.joint_q[2] = np.nan

    def lost():
        robot.publish(State(state.joint_q, state.joint_qd, time=0.01 * next(moment)))
        return np.isnan(driver.observe().joint_q[2])

    assert until(lost)

    np.testing.assert_array_equal(commanded(driver, robot, np.zeros(3)).control, np.zeros(3))


def test_others_hear_how_the_planner_does(wire):
    from warpmpc.extras.ros2.connection import Inbox
    from warpmpc.loop.realtime.agent import Fault
    from warpmpc.loop.realtime.watchdog import FaultKind

    driver, node = wire.driver(), wire.node()
    inbox = Inbox(node, "diagnostic_msgs/DiagnosticArray", "diagnostics")
    limits = wire.layout.control_lower, wire.layout.control_upper
    plan = Plan(np.zeros((2, 3), dtype=np.float32), np.arange(2.0), SplineKind.LINEAR, *limits)
    timed = TimedPlan(plan, 41, 0.9, 0.02, 12.5, True, 7.25)

    def told(fault):
        driver.tell(timed, now=1.0, fault=fault)
        return [message.status[0] for message, _ in inbox.take()]

    status = until(lambda: told(None))[-1]
    values = {pair.key: pair.value for pair in status.values}
    assert (status.level, status.message) == (status.OK, "following plans")
    assert (values["plans"], values["latency [ms]"], values["effective samples"]) == ("42", "20", "7.25")
    fault = Fault(FaultKind.PLAN_MISSING, "there is none", 0.5)
    status = until(lambda: [s for s in told(fault) if s.level == s.WARN])[-1]
    assert status.message == "sending the safe command: there is none"


def test_a_trajectory_that_is_too_long_is_not_read(wire):
    from trajectory_msgs.msg import JointTrajectoryPoint

    keys = {"command": {"type": "trajectory_msgs/JointTrajectory"}}
    driver, robot = wire.driver(**keys), wire.robot(**keys)
    moment = itertools.count()
    meet(driver, lambda: robot.publish(random_state(wire.layout, 0, 0.01 * next(moment))))

    def sent(points: int):
        message = driver._codec._message()
        message.joint_names = driver._codec._names
        message.points = [JointTrajectoryPoint(velocities=[0.0] * 3) for _ in range(points)]
        driver._commands.publish(message)
        return list(robot.receive(0.0))

    assert until(lambda: sent(100))[-1].controls.shape == (100, 3)
    assert until(lambda: [command for command in sent(20_000) if command.control.shape == (0,)])


def test_after_a_look_that_took_long_a_topic_rests(wire, monkeypatch):
    from warpmpc.extras.ros2 import connection

    node = wire.node()
    inboxes = [connection.Inbox(node, JOINTS, "long") for _ in range(2)]
    publisher = node.publisher(JOINTS, "long")

    def looked(inbox):
        publisher.publish(joint_state(["x"], [0.0]))
        return list(inbox.take())

    assert all(until(lambda inbox=inbox: looked(inbox)) for inbox in inboxes)
    monkeypatch.setattr(connection, "REST", 1e6)
    slow, quick = inboxes
    publisher.publish(joint_state(["x"], [0.0]))

    def read_slowly():
        return [time.sleep(2.0 * connection.LONG) or message for message in slow.take()]

    assert until(read_slowly)
    assert until(lambda: looked(quick))
    assert not looked(slow)
    monkeypatch.setattr(slow, "_rests", 0.0)
    assert until(lambda: looked(slow))


def test_of_many_messages_at_once_some_are_read_and_the_last_one(wire):
    from warpmpc.extras.ros2.connection import LARGEST, MOST, Inbox

    node, count = wire.node(), 100
    inbox = Inbox(node, JOINTS, "many", depth=200)
    publisher = node.publisher(JOINTS, "many")
    names = [f"joint_{k}_{'x' * 100}" for k in range(100)]  # more than 10 kB

    def first():
        publisher.publish(joint_state(["x"], [0.0]))
        return list(inbox.take())

    assert until(first)
    for named, most in ((["x"], MOST), (names, LARGEST // 10_000)):
        for k in range(count):
            publisher.publish(joint_state(named, np.full(len(named), k)))
            time.sleep(1e-3)
        time.sleep(0.1)
        found = [message.position[0] for message, _ in inbox.take()]
        assert 0 < len(found) <= most
        assert found == sorted(found)
        assert found[-1] == count - 1
