# SPDX-License-Identifier: Apache-2.0
"""The ROS 2 driver and the simulated robot's end of its topics, over real ROS 2 in this process."""

import itertools
import os
import time
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from needs import missing, needs
from small_scenes import BOX, compiled, make_scene

from warpmpc import State
from warpmpc.planner.plan import Plan
from warpmpc.planner.splines import SplineKind
from warpmpc.realtime.messages import TimedPlan
from warpmpc.robots.drivers import await_state
from warpmpc.robots.ros2.settings import Ros2Settings
from warpmpc.scene.errors import SceneError
from warpmpc.task.task import Task

pytestmark = needs("rclpy")

SCENE = make_scene(object=[BOX], scalar={"speed": 0.5})
NUMBER = itertools.count()
JOINTS = "sensor_msgs/JointState"
TWIST = "geometry_msgs/Twist"
POSE = "geometry_msgs/PoseStamped"


@pytest.fixture
def wire():
    """Makes drivers, robots' ends and plain nodes that hear nobody else, and closes them."""
    made, namespace = [], f"test_{os.getpid()}_{next(NUMBER)}"
    layout = compiled(SCENE).layout

    def settings(**keys) -> Ros2Settings:
        return Ros2Settings.model_validate({"namespace": namespace, "diagnostics": "diagnostics"} | keys)

    def driver(**keys):
        from warpmpc.robots.ros2.driver import Ros2Robot

        task = Task(SCENE)
        made.append(Ros2Robot(SCENE, task=task, compiled=compiled(SCENE), settings=settings(**keys)))
        made[-1].task = task
        return made[-1]

    def robot(**keys):
        from warpmpc.robots.ros2.transport import Ros2Transport

        made.append(Ros2Transport(layout, settings(**keys)))
        return made[-1]

    def node():
        from warpmpc.robots.ros2.connection import Connection

        made.append(Connection("other", namespace))
        return made[-1]

    yield SimpleNamespace(layout=layout, driver=driver, robot=robot, node=node)
    for each in made:
        each.close()


def until(found, seconds=5.0):
    """What a function finds, asked until it is something."""
    end = time.monotonic() + seconds
    while not (value := found()) and time.monotonic() < end:
        time.sleep(0.005)
    return value


def meet(driver, send):
    """Send until the driver has a state, for nodes take their time to find each other; the state."""

    def found():
        send()
        return driver.observe()

    return until(found)


def random_state(layout, seed, moment):
    rng = np.random.default_rng(seed)
    state = State(layout.joint_q.copy(), rng.normal(size=layout.nv).astype(np.float32), time=moment)
    state.joint_q[:6] += rng.normal(size=6)
    state.joint_q[6:10] = (turn := rng.normal(size=4)) / np.linalg.norm(turn)
    return state


def joint_state(names, position, velocity=(), *, moment=1.0):
    from sensor_msgs.msg import JointState

    message = JointState(name=list(names), position=[float(p) for p in position], velocity=list(map(float, velocity)))
    message.header.stamp.sec, nanoseconds = divmod(round(moment * 1e9), 10**9)
    message.header.stamp.nanosec = nanoseconds
    return message


def newer(driver, begin):
    """The driver's state if it is newer than a time."""
    state = driver.observe()
    return state if state.time > begin else None


@pytest.mark.parametrize("kind", ["nav_msgs/Odometry", POSE])
def test_states_and_commands_arrive_as_they_were(wire, kind):
    keys = {"pose": [{"name": "box", "topic": "box", "type": kind}]}
    driver, robot = wire.driver(**keys), wire.robot(**keys)
    moments = (0.01 * n for n in itertools.count())
    meet(driver, lambda: robot.publish(random_state(wire.layout, 0, next(moments))))
    for seed in range(1, 4):
        begin, sent = driver.observe().time, random_state(wire.layout, seed, next(moments))
        robot.publish(sent)
        found = until(partial(newer, driver, begin))
        np.testing.assert_allclose(found.joint_q, sent.joint_q, atol=1e-6)
        speeds = slice(None) if kind != POSE else slice(0, 3)  # poses tell the box's velocity by their differences
        np.testing.assert_allclose(found.joint_qd[speeds], sent.joint_qd[speeds], atol=1e-6)
    driver.apply(np.array([0.1, -0.2, 0.3], dtype=np.float32))
    (command,) = until(lambda: list(robot.receive(7.25)))  # published states are older, where a link delays them
    np.testing.assert_allclose(command.control, [0.1, -0.2, 0.3], atol=1e-7)
    assert command.stamp == 7.25


def box_odometry(moment=1.0):
    from nav_msgs.msg import Odometry

    message = Odometry()
    seconds, message.header.stamp.nanosec = divmod(round(moment * 1e9), 10**9)
    message.header.stamp.sec = seconds
    return message


def test_joints_may_come_in_parts_and_in_any_order(wire):
    driver, node = wire.driver(joints={"names": {"base/x": "wheel"}}), wire.node()
    joints, box = node.publisher(JOINTS, "joint_states"), node.publisher("nav_msgs/Odometry", "box/odometry")

    def send():
        box.publish(box_odometry())
        joints.publish(joint_state(["door", "yaw", "wheel"], [9.0, 0.3, 0.1], [0.0, 3.0, 1.0]))

    def lacking():
        send()
        assert driver.observe() is None
        return "no joint y; they have door, yaw, wheel" in driver.heard()[0].missing

    assert until(lacking)

    def rest():
        send()
        joints.publish(joint_state(["y"], [0.2], [2.0]))

    state = meet(driver, rest)
    np.testing.assert_allclose(state.joint_q[:3], [0.1, 0.2, 0.3], atol=1e-6)
    np.testing.assert_allclose(state.joint_qd[:3], [1.0, 2.0, 3.0], atol=1e-6)


def test_a_joint_that_falls_silent_stops_the_states_clock(wire):
    driver, node = wire.driver(), wire.node()
    joints, box = node.publisher(JOINTS, "joint_states"), node.publisher("nav_msgs/Odometry", "box/odometry")

    def send(names, moment):
        box.publish(box_odometry(moment))
        joints.publish(joint_state(names, np.full(len(names), moment), moment=moment))

    begin = meet(driver, lambda: send(["x", "y", "yaw"], 1.0)).time
    send(["x", "y"], 1.5)
    state = until(lambda: (state := driver.observe()).joint_q[0] == 1.5 and state)
    assert state.joint_q[2] == 1.0
    assert state.time - begin <= Ros2Settings().joints.hold + 1e-9
    send(["yaw"], 1.5)
    assert until(partial(newer, driver, begin + 0.49)).joint_q[2] == 1.5


def test_what_was_overtaken_is_left_out_and_a_clock_that_was_set_is_passed_on(wire):
    driver, robot = wire.driver(), wire.robot()
    moment = itertools.count()
    # nodes may take hundreds of messages to find each other, which are not to come near the time of the next one
    begin = meet(driver, lambda: robot.publish(random_state(wire.layout, 0, 10.0 + 1e-4 * next(moment)))).time
    robot.publish(random_state(wire.layout, 1, 11.0))
    assert until(lambda: driver.observe().time - begin > 0.8)
    robot.publish(random_state(wire.layout, 2, 10.5))
    time.sleep(0.05)
    assert driver.observe().time - begin > 0.8
    robot.publish(random_state(wire.layout, 5, 2.0))
    assert until(lambda: driver.observe().time - begin < -7.0)


def test_numbers_that_are_none_reach_the_watchdog(wire):
    driver, robot = wire.driver(), wire.robot()
    moment = itertools.count()
    meet(driver, lambda: robot.publish(random_state(wire.layout, 0, 1e-4 * next(moment))))
    broken = random_state(wire.layout, 0, 1.0)
    broken.joint_q[1] = np.nan
    robot.publish(broken)
    assert until(lambda: np.isnan(driver.observe().joint_q[1]))


def test_two_poses_of_one_time_leave_the_velocity(wire):
    driver, node = wire.driver(pose=[{"name": "box", "topic": "box", "type": POSE}]), wire.node()
    joints, box = node.publisher(JOINTS, "joint_states"), node.publisher(POSE, "box")

    def send(x, moment):
        from geometry_msgs.msg import PoseStamped

        message = PoseStamped()
        message.header.stamp, message.pose.position.x = box_odometry(moment).header.stamp, x
        box.publish(message)
        joints.publish(joint_state(["x", "y", "yaw"], np.zeros(3), moment=moment))

    begin = meet(driver, lambda: send(0.0, 1.0)).time
    send(0.2, 1.1)
    assert until(partial(newer, driver, begin + 0.05)).joint_qd[3] == pytest.approx(2.0, abs=1e-5)
    send(0.3, 1.1)
    assert until(lambda: driver.observe().joint_q[3] == pytest.approx(0.3))
    assert driver.observe().joint_qd[3] == pytest.approx(2.0, abs=1e-5)


def test_joints_without_a_velocity_have_that_of_their_positions(wire):
    driver, node = wire.driver(), wire.node()
    joints, box = node.publisher(JOINTS, "joint_states"), node.publisher("nav_msgs/Odometry", "box/odometry")

    def send(position, moment):
        box.publish(box_odometry(moment))
        joints.publish(joint_state(["x", "y", "yaw"], position, [np.nan, 5.0, np.nan], moment=moment))

    begin = meet(driver, lambda: send([0.0, 0.0, 0.0], 1.0)).time
    send([0.1, 0.2, -0.3], 1.1)
    state = until(partial(newer, driver, begin + 0.05))
    np.testing.assert_allclose(state.joint_qd[:3], [1.0, 5.0, -3.0], atol=1e-5)


def test_goals_come_on_topics_and_weights_as_parameters(wire):
    from geometry_msgs.msg import PoseStamped
    from rclpy.parameter import Parameter

    driver, node = wire.driver(), wire.node()
    goal = PoseStamped()
    goal.pose.position.x, goal.pose.orientation.z, goal.pose.orientation.w = 3.0, 2.0, 0.0
    publisher = node.publisher(POSE, "goal_pose")

    def found():
        publisher.publish(goal)
        driver.observe()
        return driver.task["goal"][0] == 3.0

    assert until(found)
    np.testing.assert_allclose(driver.task["goal"], [3.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    goal.header.frame_id, goal.pose.position.x = "map", 4.0
    publisher.publish(goal)
    assert until(lambda: driver.observe() or any("frame 'map'" in (heard.problem or "") for heard in driver.heard()))
    assert driver.task["goal"][0] == 3.0
    ros = driver._connection.node
    values = {"weight.distance": 7.0, "scalar.speed": 0.25}
    results = ros.set_parameters([Parameter(name, value=value) for name, value in values.items()])
    assert all(result.successful for result in results)
    for value in (float("nan"), float("-inf"), 1e39):  # the last is none of single precision
        (refused,) = ros.set_parameters([Parameter("weight.distance", value=value)])
        assert not refused.successful
    driver.observe()
    assert (float(driver.task["distance"]), float(driver.task["speed"])) == (7.0, 0.25)


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
    driver.apply(np.array([0.1, 0.7, 0.3], dtype=np.float32))
    (command,) = until(lambda: list(robot.receive(0.0)))
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

    def commanded():
        driver.apply(np.zeros(3, dtype=np.float32))
        return list(robot.receive(0.0))

    np.testing.assert_array_equal(until(commanded)[-1].control, np.zeros(3))


def test_others_hear_how_the_planner_does(wire):
    from warpmpc.realtime.agent import Fault
    from warpmpc.realtime.watchdog import FaultKind
    from warpmpc.robots.ros2.connection import Inbox

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


def test_a_robot_that_is_not_there_is_told_in_a_line(wire):
    driver, node = wire.driver(connect_timeout=0.5), wire.node()
    node.publisher("std_msgs/Float64MultiArray", "joint_states")
    node.publisher("nav_msgs/Odometry", "box/odometry")
    with pytest.raises(ValueError, match=r"the robot 'ros2' is not there after 0\.5 s") as error:
        await_state(driver, "ros2")
    assert "joint_states has std_msgs/Float64MultiArray, not sensor_msgs/JointState" in str(error.value)
    assert "box/odometry has a publisher, but no message came" in str(error.value)


@pytest.mark.parametrize(
    ("keys", "key"),
    [
        ({"joints": {"names": {"base/z": "lift"}}}, "joints.names"),
        ({"pose": [{"name": "cup", "topic": "cup"}]}, "pose.cup"),
        ({"pose": [{"name": "base", "topic": "odom", "planar": ["x", "y", "z"]}]}, "pose.base.planar"),
        ({"command": {"type": "trajectory_msgs/JointTrajectory", "names": ["a"]}}, "command.names"),
        ({"command": {"type": "geometry_msgs/Twist", "axes": ["linear.x", "yaw", "angular.z"]}}, "command.axes"),
        ({"command": {"type": "geometry_msgs/Twist", "heading": "z"}}, "command.heading"),
    ],
)
def test_a_file_that_does_not_fit_the_scene_is_told_by_its_key(wire, keys, key):
    with pytest.raises(SceneError) as error:
        wire.driver(**keys)
    assert error.value.key == key


@pytest.mark.skipif(not missing("tf2_msgs"), reason="tf2_msgs is there")
def test_transforms_need_a_ros_that_has_them(wire):
    with pytest.raises(ValueError, match=r"ROS package tf2_msgs: source a ROS 2 that has it; PyPI has none"):
        wire.driver(pose=[{"name": "box", "topic": "/tf", "type": "tf2_msgs/TFMessage"}])


def test_an_older_rclpy_does_not_tell_senders():
    from warpmpc.robots.ros2.connection import sender

    assert sender({"source_timestamp": 1}) == ""
    assert sender({"publisher_gid": {"data": b"\x01\xff"}}) == "01ff"


def test_a_topic_without_a_name_is_refused(wire):
    with pytest.raises(ValueError, match="'no name' is no ROS name"):
        wire.driver(joints={"topic": "no name"})


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
