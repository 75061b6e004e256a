# SPDX-License-Identifier: Apache-2.0
"""Drivers, robots' ends and nodes over real ROS 2 in this process, and messages for them."""

import itertools
import os
import time
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
from small_scenes import BOX, compiled, make_scene

from warpmpc import State, Task
from warpmpc.extras.ros2.settings import Ros2Settings

SCENE = make_scene(object=[BOX], scalar={"speed": 0.5})
NUMBER = itertools.count()
JOINTS = "sensor_msgs/JointState"
TWIST = "geometry_msgs/Twist"
POSE = "geometry_msgs/PoseStamped"


@contextmanager
def wired():
    """Makes drivers, robots' ends and plain nodes in a namespace that no other test has, and closes them."""
    made, namespace = [], f"test_{os.getpid()}_{next(NUMBER)}"
    layout = compiled(SCENE).layout

    def settings(**keys) -> Ros2Settings:
        return Ros2Settings.model_validate({"namespace": namespace, "diagnostics": "diagnostics"} | keys)

    def driver(**keys):
        from warpmpc.extras.ros2.driver import Ros2Robot

        task = Task(SCENE)
        made.append(Ros2Robot(SCENE, task=task, compiled=compiled(SCENE), settings=settings(**keys)))
        made[-1].task = task
        return made[-1]

    def robot(**keys):
        from warpmpc.extras.ros2.simulated_node import Ros2Transport

        made.append(Ros2Transport(layout, settings(**keys)))
        return made[-1]

    def node():
        from warpmpc.extras.ros2.connection import Connection

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


def commanded(driver, robot, control, *, stamp=0.0):
    """Apply a control until it reaches the robot, for a single message may be lost; the command.

    Args:
        driver: The driver.
        robot: The robot's end.
        control: Control ``[nu]``.
        stamp: Time of the newest state that the robot has published [s].
    """

    def found():
        driver.apply(np.array(control, dtype=np.float32))
        return list(robot.receive(stamp))

    return until(found)[-1]


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


def box_odometry(moment=1.0):
    from nav_msgs.msg import Odometry

    message = Odometry()
    seconds, message.header.stamp.nanosec = divmod(round(moment * 1e9), 10**9)
    message.header.stamp.sec = seconds
    return message


def box_pose(x, moment):
    """A pose of the box along x [m]."""
    from geometry_msgs.msg import PoseStamped

    message = PoseStamped()
    message.header.stamp, message.pose.position.x = box_odometry(moment).header.stamp, x
    return message
