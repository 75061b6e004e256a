# SPDX-License-Identifier: Apache-2.0
"""Topics of a robot: the keys of the driver's file, and what a scene needs where they say nothing."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from ...scene.errors import SceneError
from ...scene.types import Flag, Names, NonNegative, OneOrMore, Positive, Section
from .links import FreeJoint, PlanarJoints, free_joints

if TYPE_CHECKING:
    from pathlib import Path

    from ...model.layout import Layout
    from ...task.task import Task


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


class Pose(Section):
    """Source of a pose: of a robot's base, an object, a mocap body, the goal, a target or a movable obstacle."""

    name: str
    """Its name in the scene."""
    topic: str
    """Topic."""
    type: PoseType = PoseType.ODOMETRY
    """Type of the messages; without velocities, the mean ones between two poses are taken."""
    frame: str = ""
    """Child frame in tf messages; the name where left out."""
    planar: tuple[str, str, str] | None = None
    """Joints of a base on wheels that the message tells, along x, along y and about the vertical, where it does not
    float."""
    hold: NonNegative = 0.05
    """As for joints [s]."""


class CommandSettings(Section):
    """What the robot is sent."""

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


class Planner(Section):
    """What is told of the planner."""

    diagnostics: str | None = "/diagnostics"
    """Topic of diagnostic_msgs/DiagnosticArray: rates, latency, η, faults, twice a second."""
    markers: str | None = None
    """Topic of visualization_msgs/MarkerArray: where the plan leads, ten times a second; not sent where left out."""


class Ros2Settings(Section):
    """Topics of a robot; relative ones are in the node's namespace."""

    node: str = "warpmpc"
    """Name of the node."""
    namespace: str = ""
    """Namespace of the node."""
    world: str = "world"
    """Frame of the scene's world."""
    use_sim_time: Flag = False
    """Whether stamps are of a simulation's clock, on ``/clock``."""
    connect_timeout: Positive = 10.0
    """Time for which the first messages are waited for [s]."""
    joints: Joints = Joints()
    """Joints that the robot measures."""
    pose: Annotated[tuple[Pose, ...], OneOrMore] = ()
    """Sources of poses; those of the scene that are not named have their own default."""
    command: CommandSettings = CommandSettings()
    """What the robot is sent."""
    planner: Planner = Planner()
    """What is told of the planner."""


@dataclass(frozen=True)
class Topics:
    """Topics of a robot, for one scene.

    Raises:
        SceneError: If a name in the file is none of the scene.
    """

    settings: Ros2Settings
    joints: dict[int, str]
    """Single joint axes, by their velocity's place in the state: the robot's name for each."""
    bodies: dict[str, tuple[FreeJoint | PlanarJoints, Pose]]
    """Bodies whose pose is heard."""
    mocap: dict[int, Pose]
    """Mocap bodies whose pose is heard, by their place."""
    task: dict[str, Pose]
    """Poses of the task that may be heard."""

    @classmethod
    def of(cls, layout: Layout, settings: Ros2Settings, task: Task | None, file: Path | None = None) -> Topics:
        """Topics of a scene.

        Args:
            layout: State layout.
            settings: What the file says.
            task: The task, whose poses may be heard; none of them if None.
            file: The file, for errors.
        """
        given = {pose.name: pose for pose in settings.pose}
        task_poses = task.pose_name if task is not None else ()
        free = free_joints(layout)
        planar = {name: pose for name, pose in given.items() if pose.planar is not None}
        known = {*free, *planar, *layout.mocap_name, *task_poses}
        for name in given:
            if name not in known and task is not None:
                message = "the scene has no pose of this name; a base on wheels has planar = [x, y, yaw]"
                raise SceneError(message, key=f"pose.{name}", file=file, found=name, allowed=known)
        bodies = {
            name: (FreeJoint(layout, joint), given.get(name) or Pose(name=name, topic=f"{name}/odometry"))
            for name, joint in free.items()
        }
        elsewhere: set[int] = set()
        for name, pose in planar.items():
            try:
                moved = PlanarJoints(layout, pose.planar)
            except SceneError as error:
                raise _from_scene(error, f"pose.{name}.planar", file) from None
            bodies[name] = (moved, pose)
            elsewhere |= set(moved.qd.tolist())
        mocap = {
            i: given.get(name) or Pose(name=name, topic=f"{name}/pose", type=PoseType.POSE)
            for i, name in enumerate(layout.mocap_name)
            if name not in task_poses
        }
        topics = {name: "goal_pose" if name == "goal" else f"{name}/pose" for name in task_poses}
        poses = {name: given.get(name) or Pose(name=name, topic=topics[name], type=PoseType.POSE) for name in topics}
        return cls(settings, _joints(layout, settings.joints, elsewhere, file), bodies, mocap, poses)


def _joints(layout: Layout, joints: Joints, elsewhere: set[int], file: Path | None) -> dict[int, str]:
    """The robot's names of single axes that it measures."""
    coordinates = layout.dof_coord.tolist()

    def place(name: str, key: str) -> int:
        try:
            return coordinates.index(layout.joint(name))
        except SceneError as error:
            raise _from_scene(error, key, file) from None

    renamed = {place(name, "joints.names"): own for name, own in joints.names.items()}
    left_out = elsewhere | {place(name, "joints.unmeasured") for name in joints.unmeasured}
    names = own_names(layout.dof_name)
    found = {i: renamed.get(i, names[i]) for i, name in enumerate(layout.dof_name) if name and i not in left_out}
    if len(set(found.values())) < len(found):
        raise SceneError("two joints have the same name", key="joints.names", file=file, found=sorted(found.values()))
    return found


def own_names(names: tuple[str, ...]) -> list[str]:
    """Names without the robot's, where that tells them apart; with it, as ``robot_name``, where not."""
    short = [name.rpartition("/")[2] for name in names]
    return [own if short.count(own) == 1 else name.replace("/", "_") for own, name in zip(short, names, strict=True)]


def _from_scene(error: SceneError, key: str, file: Path | None) -> SceneError:
    return SceneError(error.message, key=key, file=file, found=error.found, allowed=error.allowed)
