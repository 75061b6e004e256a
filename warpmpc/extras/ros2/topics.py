# SPDX-License-Identifier: Apache-2.0
"""Topics of a robot for one scene: what the driver's file says, and what the scene needs where that says nothing."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING

from newton import JointType

from ...loop.estimation.free_joints import free_joints
from ...loop.estimation.legs import one_axis_joints
from ...scene.errors import SceneError
from .messages import FloatingBody, PlanarJoints
from .settings import Joints, PoseTopic, PoseType, Ros2Settings

if TYPE_CHECKING:
    from pathlib import Path

    from ...scene.model.layout import Layout
    from ...scene.task.task import Task


@dataclass(frozen=True)
class Base:
    """Topics by which a robot's base is estimated."""

    imu: str
    """Topic of its inertial measurement unit."""
    joints: tuple[str, ...]
    """The robot's own names of its joints of one axis, in the layout's order."""


@dataclass(frozen=True)
class Topics:
    """Topics of a robot, for one scene.

    Raises:
        SceneError: If the scene does not have a name in the file.
    """

    settings: Ros2Settings
    joints: dict[int, str]
    """Single joint axes, by their velocity's place in the state: the robot's name for each."""
    bodies: dict[str, tuple[FloatingBody | PlanarJoints, PoseTopic]]
    """Bodies whose pose is heard."""
    mocap: dict[int, PoseTopic]
    """Mocap bodies whose pose is heard, by their place."""
    measured: dict[str, PoseTopic]
    """Measured poses of things that are estimated."""
    bases: dict[str, Base]
    """Robots whose base is estimated."""
    task: dict[str, PoseTopic]
    """Poses of the task that may be heard."""

    @classmethod
    def of(
        cls,
        layout: Layout,
        settings: Ros2Settings,
        task: Task | None,
        file: Path | None = None,
        *,
        estimated: Collection[str] = (),
        bases: Collection[str] = (),
    ) -> Topics:
        """Topics of a scene.

        Args:
            layout: State layout.
            settings: What the file says.
            task: The task, whose poses may be heard; no poses if None.
            file: The file, for errors.
            estimated: Bodies that are estimated from measured poses.
            bases: Robots whose base is estimated from an inertial measurement unit.
        """
        balls = [
            name for name, kind in zip(layout.joint_name, layout.joint_type, strict=True) if kind == JointType.BALL
        ]
        if balls:
            message = "no ROS message describes ball joints: use another driver, or joints of one axis"
            raise SceneError(message, key="joints", file=file, found=balls[0])
        given = {pose.name: pose for pose in settings.pose}
        task_poses = task.pose_name if task is not None else ()
        free = free_joints(layout)
        planar = {name: pose for name, pose in given.items() if pose.planar is not None}
        known = {*free, *planar, *layout.mocap_name, *task_poses}
        for name in given:
            if name in bases:
                message = "its base is estimated from a unit and joints: leave it out, or the scene's estimate_base"
                raise SceneError(message, key=f"pose.{name}", file=file, found=name)
            if name not in known and task is not None:
                message = "the scene has no pose of this name; a base on wheels has planar = [x, y, yaw]"
                raise SceneError(message, key=f"pose.{name}", file=file, found=name, allowed=known)
        bodies = {
            name: (FloatingBody(layout, joint), _typed(own, PoseType.ODOMETRY))
            for name, joint in free.items()
            for own in [given.get(name) or PoseTopic(name=name, topic=f"{name}/odometry")]
            if name not in estimated and name not in bases
        }
        measured = {name: _pose(given, name) for name in free if name in estimated}
        elsewhere: set[int] = set()
        for name, pose in planar.items():
            pose = _typed(pose, PoseType.ODOMETRY)
            try:
                moved = PlanarJoints(layout, pose.planar)
            except SceneError as error:
                raise _from_scene(error, f"pose.{name}.planar", file) from None
            bodies[name] = (moved, pose)
            elsewhere |= set(moved.qd.tolist())
        mocap = {i: _pose(given, name) for i, name in enumerate(layout.mocap_name) if name not in task_poses}
        poses = {name: _pose(given, name) for name in task_poses}
        joints = _joints(layout, settings.joints, elsewhere, file)
        based = _bases(layout, settings, bases, joints, file)
        return cls(settings, joints, bodies, mocap, measured, based, poses)


def _pose(given: dict[str, PoseTopic], name: str) -> PoseTopic:
    """The source of a pose without a velocity: what the file says, or its default."""
    topic = "goal_pose" if name == "goal" else f"{name}/pose"
    return _typed(given.get(name) or PoseTopic(name=name, topic=topic), PoseType.POSE)


def _typed(pose: PoseTopic, kind: PoseType) -> PoseTopic:
    """A source with a type: a given one if it has none."""
    return pose if pose.type is not None else pose.model_copy(update={"type": kind})


def _bases(
    layout: Layout, settings: Ros2Settings, names: Collection[str], joints: dict[int, str], file: Path | None
) -> dict[str, Base]:
    """Topics of estimated bases."""
    given, found = {imu.name: imu.topic for imu in settings.imu}, {}
    for name in given:
        if name not in names:
            message = "the scene estimates no base of this name: leave it out, or add [estimate_base]"
            raise SceneError(message, key=f"imu.{name}", file=file, found=name, allowed=names)
    for name in names:
        dofs = layout.joint_qd_start[one_axis_joints(layout, name, key=f"estimate_base.{name}")].tolist()
        if unmeasured := [layout.dof_name[dof] for dof in dofs if dof not in joints]:
            message = f"the base of {name} is estimated from all its joints"
            raise SceneError(message, key="joints.unmeasured", file=file, found=unmeasured)
        found[name] = Base(given.get(name, f"{name}/imu"), tuple(joints[dof] for dof in dofs))
    return found


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
