# SPDX-License-Identifier: Apache-2.0
"""Keys of the driver's file."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from pydantic import Field

from ...loop.robots.drivers import Driver
from ...scene.types import Flag, Names, NonNegative, OneOrMore, Positive, Section


class PoseType(StrEnum):
    """Messages that tell where a body is."""

    ODOMETRY = "nav_msgs/Odometry"
    POSE = "geometry_msgs/PoseStamped"
    TRANSFORMS = "tf2_msgs/TFMessage"


class CommandType(StrEnum):
    """Messages that command the robot."""

    ARRAY = "std_msgs/Float64MultiArray"
    TRAJECTORY = "trajectory_msgs/JointTrajectory"
    TWIST = "geometry_msgs/Twist"
    STAMPED_TWIST = "geometry_msgs/TwistStamped"


class TrajectoryField(StrEnum):
    """Numbers of a trajectory's points."""

    POSITIONS = "positions"
    VELOCITIES = "velocities"
    ACCELERATIONS = "accelerations"
    EFFORT = "effort"


class Joints(Section):
    """Joints that the robot measures."""

    topic: str = "joint_states"
    """Topic of sensor_msgs/JointState; messages may have any of the joints, in any order, and others."""
    names: dict[str, str] = Field(default_factory=dict)
    """Joint of the scene → the robot's name for it; its own name where left out."""
    unmeasured: tuple[str, ...] = ()
    """Joints of the scene that the robot does not measure: they stay as they are at the scene's start."""
    hold: NonNegative = 0.02
    """Age up to which a joint is taken as it is while others are newer; beyond it the state's time waits [s]."""


class PoseTopic(Section):
    """Source of a pose: of a robot's base, an object, a mocap body, the goal, a target or a movable obstacle."""

    name: str
    """Its name in the scene."""
    topic: str
    """Topic."""
    type: PoseType | None = None
    """Type of the messages: odometry for bodies, poses for what is estimated and for the task, where left out. Without
    velocities, the mean ones between two poses are taken."""
    frame: str = ""
    """Child frame in tf messages; the name where left out."""
    planar: tuple[str, str, str] | None = None
    """Joints of a base on wheels that the message tells, along x, along y and about the vertical, where it does not
    float."""
    hold: NonNegative = 0.05
    """As for joints [s]."""


class Imu(Section):
    """Inertial measurement unit of a robot whose base the scene estimates."""

    name: str
    """The robot."""
    topic: str
    """Topic of sensor_msgs/Imu, whose orientation is not used."""


class CommandSettings(Section):
    """Commands to the robot."""

    topic: str = "commands"
    """Topic."""
    type: CommandType = CommandType.ARRAY
    """Type of the messages: controls in their order, the plan's next ones with their times, or a base's velocity."""
    names: Names | None = None
    """Joint names of a trajectory, one for each control; those of the controls where left out."""
    field: TrajectoryField | None = None
    """Numbers of a trajectory that the controls are; by the drives where left out."""
    axes: Names = ("linear.x", "linear.y", "angular.z")
    """Components of a twist, one for each control."""
    heading: str | None = None
    """Joint that turns the base, where its controls are velocities along the world's axes and a twist's along its own.
    """


class Ros2Settings(Section):
    """Topics of a robot; relative ones are in the node's namespace."""

    node: str = "warpmpc"
    """Name of the node."""
    namespace: str = ""
    """Namespace of the node."""
    world: str = "world"
    """Frame of the scene's world; poses in another one are refused."""
    use_sim_time: Flag = False
    """Whether stamps are of a simulation's clock, on ``/clock``."""
    connect_timeout: Positive = 10.0
    """Time for which the first messages are waited for [s]."""
    diagnostics: str = "/diagnostics"
    """Topic of diagnostic_msgs/DiagnosticArray, twice a second: plans, their rate, latency and η, the fault if there is
    one."""
    rollouts: str = "rollouts"
    """Topic of visualization_msgs/MarkerArray: paths of the cheapest rollout and of sampled ones, while somebody
    listens."""
    joints: Joints = Joints()
    """Joints that the robot measures."""
    pose: Annotated[tuple[PoseTopic, ...], OneOrMore] = ()
    """Sources of poses; those of the scene that are not named have their own default."""
    imu: Annotated[tuple[Imu, ...], OneOrMore] = ()
    """Inertial measurement units; those of estimated bases that are not named have ``NAME/imu``."""
    command: CommandSettings = CommandSettings()
    """Commands to the robot."""


DRIVER = Driver(
    summary="States, commands, goals and weights through ROS 2 topics and parameters.",
    make="warpmpc.extras.ros2.driver:Ros2Robot",
    package="rclpy",
    extra="ros2",
    settings=Ros2Settings,
)
"""Entry point of the driver, in the group ``warpmpc.robots``."""
