# SPDX-License-Identifier: Apache-2.0
"""The ROS 2 driver: states, goals and settings, over real ROS 2 in this process."""

import itertools
import time
from functools import partial

import numpy as np
import pytest
from needs import missing, needs
from ros2_wire import (
    JOINTS,
    POSE,
    box_odometry,
    box_pose,
    commanded,
    joint_state,
    meet,
    newer,
    random_state,
    until,
    wired,
)

from warpmpc import SceneError
from warpmpc.extras.ros2.settings import Ros2Settings
from warpmpc.loop.robots.drivers import await_state

pytestmark = needs("rclpy")


@pytest.fixture
def wire():
    """What makes drivers, robots' ends and nodes that hear no other test."""
    with wired() as made:
        yield made


def arrived(driver, begin, sent):
    """The driver's newer state once all its parts, which come on separate topics, are those sent."""
    state = newer(driver, begin)
    return state if state and np.allclose(state.joint_q, sent.joint_q, atol=1e-6) else None


@pytest.mark.parametrize("kind", ["nav_msgs/Odometry", POSE])
def test_states_and_commands_arrive_as_they_were(wire, kind):
    keys = {"pose": [{"name": "box", "topic": "box", "type": kind}]}
    driver, robot = wire.driver(**keys), wire.robot(**keys)
    moments = (0.01 * n for n in itertools.count())
    meet(driver, lambda: robot.publish(random_state(wire.layout, 0, next(moments))))
    for seed in range(1, 4):
        begin, sent = driver.observe().time, random_state(wire.layout, seed, next(moments))
        robot.publish(sent)
        found = until(partial(arrived, driver, begin, sent)) or driver.observe()
        np.testing.assert_allclose(found.joint_q, sent.joint_q, atol=1e-6)
        speeds = slice(None) if kind != POSE else slice(0, 3)  # poses tell the box's velocity by their differences
        np.testing.assert_allclose(found.joint_qd[speeds], sent.joint_qd[speeds], atol=1e-6)
    command = commanded(
        driver, robot, [0.1, -0.2, 0.3], stamp=7.25
    )  # published states are older, where a link delays them
    np.testing.assert_allclose(command.control, [0.1, -0.2, 0.3], atol=1e-7)
    assert command.stamp == 7.25


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
    last = 10.0 + 1e-4 * next(moment)
    robot.publish(random_state(wire.layout, 1, last + 0.09))
    newest = until(partial(newer, driver, begin + 0.08)).time
    robot.publish(random_state(wire.layout, 2, last + 0.05))
    time.sleep(0.05)
    assert driver.observe().time == newest
    robot.publish(random_state(wire.layout, 5, 2.0))
    assert until(lambda: driver.observe().time - begin < -7.0)


def test_a_message_with_a_time_that_is_wrong_holds_up_none_after_it(wire):
    driver, node = wire.driver(pose=[{"name": "box", "topic": "box", "type": POSE}]), wire.node()
    joints, box = node.publisher(JOINTS, "joint_states"), node.publisher(POSE, "box")

    def send(x, moment):
        box.publish(box_pose(x, moment))
        joints.publish(joint_state(["x", "y", "yaw"], [x, 0.0, 0.0], moment=moment))

    begin = meet(driver, lambda: send(0.0, 10.0)).time
    for wrong in (0.6, -5.0, 500.0):
        send(0.04, 10.0 + wrong)
        assert until(lambda wrong=wrong: driver.observe().time == pytest.approx(begin + wrong, abs=0.15))
    send(0.08, 10.08)
    state = until(lambda: (s := driver.observe()).time == pytest.approx(begin + 0.08, abs=1e-3) and s)
    assert state.joint_qd[[0, 3]] == pytest.approx([1.0, 1.0], abs=1e-3)  # from the messages whose times were right


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
        box.publish(box_pose(x, moment))
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
    for value in (float("nan"), float("-inf"), 1e39):  # the last does not fit into single precision
        (refused,) = ros.set_parameters([Parameter("weight.distance", value=value)])
        assert not refused.successful
    driver.observe()
    assert (float(driver.task["distance"]), float(driver.task["speed"])) == (7.0, 0.25)


def test_a_robot_that_is_not_there_is_told_in_a_line(wire):
    driver, node = wire.driver(connect_timeout=4.0), wire.node()
    node.publisher("std_msgs/Float64MultiArray", "joint_states")
    node.publisher("nav_msgs/Odometry", "box/odometry")
    with pytest.raises(ValueError, match=r"the robot 'ros2' is not there after 4 s") as error:
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
    from warpmpc.extras.ros2.connection import sender

    assert sender({"source_timestamp": 1}) == ""
    assert sender({"publisher_gid": {"data": b"\x01\xff"}}) == "01ff"


def test_a_topic_without_a_name_is_refused(wire):
    with pytest.raises(ValueError, match="'no name' is no ROS name"):
        wire.driver(joints={"topic": "no name"})
