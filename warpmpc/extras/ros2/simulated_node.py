# SPDX-License-Identifier: Apache-2.0
"""The simulated robot's end: a node that publishes what is measured and hears commands."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...loop.estimation.measurement import ImuMeasured, JointsMeasured, PoseMeasured
from ...loop.robots.safety import Command
from .commands import CommandCodec
from .connection import Connection, Inbox, message_class
from .messages import FloatingBody, Link, PlanarJoints, RosTime, floats, write_odometry, write_pose, write_transform
from .settings import PoseTopic, PoseType, Ros2Settings
from .topics import Base, Topics

if TYPE_CHECKING:
    from ...loop.estimation.measurement import Measurement
    from ...scene.model.layout import Layout
    from ...scene.model.state import State

NODE = "robot"
"""Name of the robot's node."""
CLOCK_PERIOD = 0.02
"""Time between messages on ``/clock``, on the robot's clock [s]."""


class Ros2Transport:
    """Publishes joints, bodies and ``/clock``, and hears commands, on the topics of the driver's settings.

    Stamps are the time at which it began and, from there, the robot's clock; ``/clock`` has the same.

    Args:
        layout: State layout.
        settings: Topics.
        file: File of the settings, for errors.
        estimated: Bodies of which only measured poses are sent.
        bases: Robots of which only measurements of units and joints are sent.

    Raises:
        SceneError: If the settings do not fit the scene.
        ValueError: If a topic's name is none, or the package of its messages is missing.
    """

    measures = (PoseMeasured, ImuMeasured, JointsMeasured)
    """Kinds of measurements that it sends."""

    def __init__(
        self,
        layout: Layout,
        settings: Ros2Settings,
        file: Path | None = None,
        *,
        estimated: Collection[str] = (),
        bases: Collection[str] = (),
    ):
        self._clock = RosTime(time.time_ns())
        topics = Topics.of(layout, settings, None, file, estimated=estimated, bases=bases)
        told = {name for base in topics.bases.values() for name in base.joints}
        self.joints: dict[str, int] = {name: dof for dof, name in topics.joints.items() if name not in told}
        """Joints that are published: places of their velocities in the state by name."""
        self._codec = CommandCodec(layout, settings.command, self._clock, file)
        self._connection = Connection(NODE, settings.namespace)
        try:
            self._publish: list[Callable[[State], None]] = [*self._publishers(layout, topics)]
            self._measured = {name: self._pose_publisher(pose, topics) for name, pose in topics.measured.items()}
            self._bases = {name: self._base_publishers(base, topics) for name, base in topics.bases.items()}
            self._commands = Inbox(self._connection, str(settings.command.type), settings.command.topic, reliable=True)
        except ValueError:
            self._connection.close()
            raise
        self._joint_q = layout.joint_q

    def publish(self, state: State) -> None:
        """Send what the robot measures."""
        self._joint_q = state.joint_q
        for publish in self._publish:
            publish(state)

    def tell(self, measurements: Sequence[Measurement]) -> None:
        """Send measurements of what is estimated; states have the other poses as they were measured last."""
        for measured in measurements:
            if isinstance(measured, PoseMeasured):
                if (publish := self._measured.get(measured.name)) is not None:
                    publish(measured.time, Link(measured.pose))
            elif (publishers := self._bases.get(measured.name)) is not None:
                publishers[type(measured)](measured)

    def receive(self, now: float) -> Iterator[Command]:
        """Commands that came since the last call, in their order; those without a header count from now on.

        Args:
            now: The robot's clock [s]; published states may be older.
        """
        for message, sender in self._commands.take():
            times, controls, stamp = self._codec.read(message, self._joint_q)
            trajectory = (times, controls) if len(times) > 1 else None
            yield Command(controls[0], now if stamp is None else stamp, sender, trajectory)

    def close(self) -> None:
        """End the node."""
        self._connection.close()

    def _publishers(self, layout: Layout, topics: Topics) -> Iterator[Callable[[State], None]]:
        yield self._clock_publisher()
        if self.joints:
            yield self._joint_publisher(layout, topics)
        for joint, pose in topics.bodies.values():
            publish = self._pose_publisher(pose, topics)
            yield lambda state, publish=publish, joint=joint: publish(state.time, _link(joint, state))
        for place, pose in topics.mocap.items():
            publish = self._pose_publisher(pose, topics)
            yield lambda state, publish=publish, i=place: publish(state.time, Link(state.mocap[i].astype(float)))

    def _clock_publisher(self) -> Callable[[State], None]:
        publisher = self._connection.publisher("rosgraph_msgs/Clock", "/clock")
        message, due = message_class("rosgraph_msgs/Clock")(), [-math.inf]

        def publish(state: State) -> None:
            if state.time >= due[0]:
                due[0] = state.time + CLOCK_PERIOD
                self._clock.write(state.time, message.clock)
                publisher.publish(message)

        return publish

    def _joint_publisher(self, layout: Layout, topics: Topics) -> Callable[[State], None]:
        kind = "sensor_msgs/JointState"
        publisher = self._connection.publisher(kind, topics.settings.joints.topic)
        message = message_class(kind)()

        def publish(state: State) -> None:
            self._clock.write(state.time, message.header.stamp)
            dofs = list(self.joints.values())
            message.name = list(self.joints)
            message.position = floats(state.joint_q[layout.dof_coord[dofs]])
            message.velocity = floats(state.joint_qd[dofs])
            publisher.publish(message)

        return publish

    def _base_publishers(self, base: Base, topics: Topics) -> dict[type, Callable[[Any], None]]:
        """Publish what a unit and joints show, by the kind of the measurement."""
        kinds = "sensor_msgs/Imu", "sensor_msgs/JointState"
        names = base.imu, topics.settings.joints.topic
        unit, joints = (self._connection.publisher(kind, topic) for kind, topic in zip(kinds, names, strict=True))
        imu, state = (message_class(kind)() for kind in kinds)
        imu.orientation_covariance[0] = -1.0  # it tells no orientation
        state.name = list(base.joints)

        def publish_unit(measured: ImuMeasured) -> None:
            self._clock.write(measured.time, imu.header.stamp)
            for vector, values in ((imu.angular_velocity, measured.gyro), (imu.linear_acceleration, measured.accel)):
                vector.x, vector.y, vector.z = map(float, values)
            unit.publish(imu)

        def publish_joints(measured: JointsMeasured) -> None:
            self._clock.write(measured.time, state.header.stamp)
            state.position, state.velocity, state.effort = map(floats, (measured.q, measured.qd, measured.effort))
            joints.publish(state)

        return {ImuMeasured: publish_unit, JointsMeasured: publish_joints}

    def _pose_publisher(self, pose: PoseTopic, topics: Topics) -> Callable[[float, Link], None]:
        """Publish links of times [s]."""
        publisher = self._connection.publisher(str(pose.type), pose.topic)
        message = message_class(str(pose.type))()
        stamped = message
        if pose.type is PoseType.TRANSFORMS:
            stamped = message_class("geometry_msgs/TransformStamped")()
            message.transforms.append(stamped)
        if pose.type is not PoseType.POSE:
            stamped.child_frame_id = pose.frame or pose.name
        stamped.header.frame_id = topics.settings.world

        def publish(at: float, link: Link) -> None:
            self._clock.write(at, stamped.header.stamp)
            match pose.type:
                case PoseType.ODOMETRY:
                    write_odometry(link, message)
                case PoseType.POSE:
                    write_pose(link.pose, message.pose)
                case PoseType.TRANSFORMS:
                    write_transform(link.pose, stamped.transform)
            publisher.publish(message)

        return publish


def _link(joint: FloatingBody | PlanarJoints, state: State) -> Link:
    return joint.link(state.joint_q[joint.q], state.joint_qd[joint.qd])
