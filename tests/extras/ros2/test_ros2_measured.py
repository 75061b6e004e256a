# SPDX-License-Identifier: Apache-2.0
"""Measurements of what a scene estimates, over real ROS 2 in this process."""

import itertools
import os
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from estimated_dog import dog, trot
from needs import needs
from scipy.spatial.transform import Rotation
from small_scenes import BOX, compiled, make_scene

from warpmpc import SceneError, State, Task
from warpmpc.extras.ros2.settings import Ros2Settings
from warpmpc.loop.estimation.measurement import PoseMeasured
from warpmpc.loop.robots.drivers import make_robot
from warpmpc.loop.robots.estimated import EstimatedRobot
from warpmpc.loop.robots.simulated import RobotProcess
from warpmpc.scene.draw import draw_task
from warpmpc.scene.model.compiled import compile_scene
from warpmpc.scene.schema_estimate import Estimate

pytestmark = needs("rclpy")

SCENE = make_scene(object=[BOX]).model_copy(update={"estimate": {"box": Estimate(gate=None)}})
NUMBER = itertools.count()


@pytest.fixture
def ends():
    """A driver of the scene and the robot's end of its topics."""
    from warpmpc.extras.ros2.driver import Ros2Robot
    from warpmpc.extras.ros2.simulated_node import Ros2Transport

    layout = compiled(SCENE).layout
    settings = Ros2Settings(namespace=f"measured_{os.getpid()}_{next(NUMBER)}", diagnostics="diagnostics")
    driver = Ros2Robot(SCENE, compiled=compiled(SCENE), settings=settings)
    robot = Ros2Transport(layout, settings, estimated=SCENE.estimate)
    yield driver, robot
    robot.close()
    driver.close()


def measured(at: float, x: float) -> PoseMeasured:
    return PoseMeasured("box", at, np.array([x, 0.2, 0.15, 0.0, 0.0, 0.6, 0.8]))


def told(driver, send, seconds=5.0):
    """Measurements that a driver has, sent until they come, for nodes take their time to find each other."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        send()
        time.sleep(0.01)
        if found := driver.measurements():
            return found
    return []


def test_measured_poses_come_with_the_time_at_which_they_were_measured(ends):
    driver, robot = ends
    state = State.start(compiled(SCENE).layout)
    moment = itertools.count()

    def met():
        robot.publish(replace(state, time=1e-3 * next(moment)))
        return driver.observe()

    begin = time.monotonic()
    while (seen := met()) is None and time.monotonic() < begin + 5.0:
        time.sleep(0.01)
    assert seen is not None, "joints are enough for a state: the box is measured"
    offset = seen.time - 1e-3 * (next(moment) - 1)  # the driver's seconds count from another one
    assert told(driver, lambda: robot.tell([measured(0.5, 0.0)]))
    time.sleep(0.1)
    driver.measurements()
    robot.tell([measured(0.9, 0.3)])
    robot.publish(replace(state, time=1.0))
    time.sleep(0.1)
    (found,) = driver.measurements()
    np.testing.assert_allclose(found.pose, measured(0.0, 0.3).pose, atol=1e-7)
    later = driver.observe()
    assert later.time - found.time == pytest.approx(0.1, abs=2e-3)
    assert later.time == pytest.approx(1.0 + offset, abs=0.02)


def test_a_box_is_estimated_from_its_topic_and_a_pose_without_a_time_is_refused(ends):
    driver, robot = ends
    from geometry_msgs.msg import PoseStamped

    estimated = EstimatedRobot(driver, SCENE, compiled(SCENE))
    start = State.start(compiled(SCENE).layout)
    assert any("box/pose" in heard.source for heard in estimated.heard())
    ticks = itertools.count()

    def tick():
        now = 0.01 * next(ticks)
        robot.tell([measured(now, 0.5 * now)])
        robot.publish(replace(start, time=now))
        time.sleep(0.005)
        return estimated.observe(), now

    begin = time.monotonic()
    while tick()[0] is None and time.monotonic() < begin + 5.0:
        pass
    for _ in range(100):
        seen, now = tick()
    joint = compiled(SCENE).layout.nq - 7
    assert seen.joint_q[joint] == pytest.approx(0.5 * now, abs=0.02), "it moves at half a metre a second"
    np.testing.assert_allclose(seen.joint_qd[-6:-3], [0.5, 0.0, 0.0], atol=0.1)
    publisher = driver._connection.publisher("geometry_msgs/PoseStamped", "box/pose")
    message = PoseStamped()
    message.pose.orientation.w = 1.0
    (heard,) = [heard for heard in driver.heard() if heard.source.endswith("box/pose")]
    end = time.monotonic() + 5.0
    while not heard.refused and time.monotonic() < end:
        publisher.publish(message)
        time.sleep(0.01)
        estimated.observe()
    assert "header.stamp" in heard.problem


@pytest.fixture
def walker(tmp_path):
    """A quadruped that ticks in a thread, its driver with what the scene estimates, and its true states by time."""
    from warpmpc.extras.ros2.simulated_node import Ros2Transport

    scene, namespace, over = draw_task(dog(), 0)[0], f"dog_{os.getpid()}_{next(NUMBER)}", threading.Event()
    settings = Ros2Settings(namespace=namespace, diagnostics="diagnostics")
    file = tmp_path / "dog.toml"
    file.write_text(f'namespace = "{namespace}"\ndiagnostics = "diagnostics"\n')
    process = RobotProcess(scene, lambda layout: Ros2Transport(layout, settings, bases=scene.estimate_base), speed=0.2)
    robot = make_robot(f"ros2:{file}", scene, task=Task(scene), compiled=compile_scene(scene))
    true = []

    def ended():
        if process._began is not None:
            seconds = process._began + process.plant.time
            true.append((1e-9 * process.transport._clock._epoch + seconds, process.plant.state))
        return over.is_set()

    thread = threading.Thread(target=process.run, args=[ended])
    thread.start()
    yield process.plant, robot, true
    over.set()
    thread.join(30.0)
    robot.close()


def test_a_base_is_estimated_from_its_unit_and_joints(walker, caplog):
    plant, robot, true = walker
    assert isinstance(robot, EstimatedRobot), "nothing is left unused"
    assert not caplog.messages
    end, states = time.monotonic() + 60.0, []
    while robot.observe() is None and time.monotonic() < end:
        time.sleep(0.01)
    assert not any("odometry" in heard.source for heard in robot.heard())
    while plant.time < 1.2 and time.monotonic() < end:
        robot.apply(trot(plant))
        states.append(robot.observe())
        time.sleep(0.004)
    assert plant.time >= 1.2, [heard.missing for heard in robot.heard()]
    epoch, when, errors = 1e-9 * robot._observer._clock._epoch, np.array([moment for moment, _ in true]), []
    for seen in states:
        near = np.argmin(np.abs(when - epoch - seen.time))
        if abs(when[near] - epoch - seen.time) > 0.01:
            continue  # before it was commanded
        there = true[near][1]
        turn = Rotation.from_quat(there.joint_q[3:7]).inv() * Rotation.from_quat(seen.joint_q[3:7])
        errors.append([turn.magnitude(), *np.abs(seen.joint_q - there.joint_q)])
    assert len(errors) > 50
    errors = np.array(errors)
    assert np.median(errors[:, 0]) < np.radians(4.0)
    assert np.median(errors[:, 1:4], axis=0).max() < 0.05
    assert np.median(errors[:, 8:], axis=0).max() < 0.05


def test_an_estimated_base_needs_all_joints_and_a_unit_that_the_scene_has():
    from warpmpc.extras.ros2.topics import Topics

    scene = dog()
    layout, bases = compile_scene(scene).layout, scene.estimate_base
    joints = [name for name in layout.dof_name if name.startswith("dog/")]
    unmeasured = Ros2Settings(joints={"unmeasured": joints[-1:]})
    with pytest.raises(SceneError, match="from all its joints"):
        Topics.of(layout, unmeasured, None, bases=bases)
    other = Ros2Settings(imu=[{"name": "cat", "topic": "imu"}])
    with pytest.raises(SceneError, match="estimates no base of this name"):
        Topics.of(layout, other, None, bases=bases)
    found = Topics.of(layout, Ros2Settings(imu=[{"name": "dog", "topic": "imu/data"}]), None, bases=bases)
    assert found.bases["dog"].imu == "imu/data"
    assert len(found.bases["dog"].joints) == 12
    assert not found.bodies
    with pytest.raises(SceneError, match="estimated from a unit and joints"):
        Topics.of(layout, Ros2Settings(pose=[{"name": "dog", "topic": "odom"}]), None, bases=bases)


def test_a_pose_without_a_type_has_that_of_its_use():
    from warpmpc.extras.ros2.topics import Topics

    layout, settings = compiled(SCENE).layout, Ros2Settings(pose=[{"name": "box", "topic": "camera/box"}])
    assert str(Topics.of(layout, settings, None, estimated=["box"]).measured["box"].type) == "geometry_msgs/PoseStamped"
    assert str(Topics.of(layout, settings, None).bodies["box"][1].type) == "nav_msgs/Odometry"


def test_units_and_joints_that_tell_too_little_are_refused():
    from sensor_msgs.msg import Imu, JointState

    from warpmpc.extras.ros2.connection import Connection
    from warpmpc.extras.ros2.messages import RosTime
    from warpmpc.extras.ros2.observer import Measurements
    from warpmpc.extras.ros2.topics import Topics

    scene = dog()
    settings = Ros2Settings(namespace=f"short_{os.getpid()}")
    topics = Topics.of(compile_scene(scene).layout, settings, None, bases=scene.estimate_base)
    names = list(topics.bases["dog"].joints)
    connection, other = Connection("driver", settings.namespace), Connection("robot", settings.namespace)
    try:
        bases = Measurements(topics, connection, RosTime())
        unit, joints = (
            other.publisher(kind, topic)
            for kind, topic in (("sensor_msgs/Imu", "dog/imu"), ("sensor_msgs/JointState", "joint_states"))
        )
        blind, part, lazy = Imu(), JointState(), JointState()
        blind.linear_acceleration_covariance[0] = -1.0
        part.name, part.position = names[:3], [0.0] * 3
        lazy.name, lazy.position, lazy.velocity = names, [0.0] * 12, [0.0] * 12
        for publisher, message, words in (
            (unit, blind, "covariance of -1"),
            (joints, part, "not all"),
            (joints, lazy, "no efforts"),
        ):
            message.header.stamp.sec, end = 5, time.monotonic() + 10.0
            while not any(words in (heard.problem or "") for heard in bases.heard()):
                assert time.monotonic() < end, words
                publisher.publish(message)
                time.sleep(0.01)
                assert not bases.take()
    finally:
        connection.close()
        other.close()
