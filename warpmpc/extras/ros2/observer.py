# SPDX-License-Identifier: Apache-2.0
"""States from what a robot's topics tell.

Measurements of what a scene estimates, from their topics: poses of things, units and joints of robots.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from ...loop.estimation.measurement import ImuMeasured, JointsMeasured, PoseMeasured
from ...loop.robots.sources import BACK, Heard, Stamps
from ...scene.errors import some
from ...scene.model.state import State
from .connection import DEPTH, Connection, Inbox
from .messages import JointOrder, Link, Message, RosTime, difference, read_links
from .settings import PoseTopic, PoseType

if TYPE_CHECKING:
    from collections.abc import Callable

    from ...loop.estimation.measurement import Measurement
    from ...scene.model.layout import Layout
    from .topics import Topics


class Newest:
    """Times of the parts of a state, each of which may be older than the newest by its own measure.

    The state's time is that of the newest part; where a part is older than it may be, the state's time waits for it,
    so that the age of states shows it.

    Args:
        holds: Age that is allowed of each part ``[n]`` [s].
    """

    def __init__(self, holds: np.ndarray):
        self.stamps, self._holds = np.full(len(holds), np.nan), holds
        self.believed = self.stamps.copy()
        """Times of the newest messages whose times can be true ``[n]`` [s]."""

    @property
    def time(self) -> float:
        """Time of the state [s]; NaN while a part was never seen."""
        return float(min(np.max(self.stamps), np.min(self.stamps + self._holds)))

    def overtaken(self, parts: np.ndarray | int, stamp: float) -> bool:
        """Return whether a message is older than what is known of its parts, though not of a clock that was set."""
        lag = np.max(self.believed[parts]) - stamp
        return bool(0.0 < lag < BACK)


class Observer:
    """Joints, floating bodies and mocap bodies of a state, from their topics.

    Args:
        layout: State layout.
        topics: Which topic tells what.
        connection: The node.
        clock: Turns stamps into seconds.

    Raises:
        ValueError: If a topic's name is none, or the package of its messages is missing.
    """

    def __init__(self, layout: Layout, topics: Topics, connection: Connection, clock: RosTime):
        self._clock = clock
        self._q, self._qd = layout.joint_q.astype(float), layout.joint_qd.astype(float)
        self._before, self._stamps = self._q.copy(), Stamps()  # joints of times that can be true
        self._mocap = layout.mocap.astype(np.float32)
        self._act_speed = layout.activation_speed
        joints = topics.joints
        self._dofs = np.array(list(joints), dtype=int)
        self._coordinates, self._names = layout.dof_coord[self._dofs], list(joints.values())
        self._order = JointOrder(self._names)
        holds = [topics.settings.joints.hold] * len(joints)
        self._sources: list[_PoseSource] = []
        world = topics.settings.world
        for name, (joint, pose) in topics.bodies.items():
            self._sources.append(_PoseSource(connection, pose, name, len(holds), world, joint=joint))
            holds.append(pose.hold)
        for place, pose in topics.mocap.items():
            self._sources.append(_PoseSource(connection, pose, pose.name, len(holds), world, mocap=place))
            holds.append(pose.hold)
        self._newest = Newest(np.array(holds))
        self._joints: Inbox | None = None
        self._heard: list[Heard] = []
        if joints:
            self._joints = Inbox(connection, "sensor_msgs/JointState", topics.settings.joints.topic)
            self._heard.append(Heard(self._joints.topic, self._joints.kind))
        self._heard += [source.heard for source in self._sources]
        self._state: State | None = None

    def heard(self) -> list[Heard]:
        """Messages of each topic; of a silent one its problem says why."""
        inboxes = [self._joints] * (self._joints is not None) + [source.inbox for source in self._sources]
        for heard, inbox in zip(self._heard, inboxes, strict=True):
            if not heard.count and not heard.refused:
                heard.problem = inbox.silence()
        return self._heard

    def observe(self) -> State | None:
        """The newest state, None before every part was seen; returns at once."""
        changed = self._joints is not None and self._take_joints()
        for source in self._sources:
            changed = self._take_pose(source) or changed
        if changed and not np.isnan(time := self._newest.time):
            act = None
            if len(self._act_speed) and (self._act_speed >= 0).all():
                act = self._qd[self._act_speed].astype(np.float32)
            mocap = self._mocap.copy() if len(self._mocap) else None
            q, qd = self._q.astype(np.float32), self._qd.astype(np.float32)
            self._state = State(q, qd, time=time, act=act, mocap=mocap)
        return self._state

    def _lacking(self) -> str | None:
        """A sentence about joints that no message has had yet."""
        missing = [name for i, name in enumerate(self._names) if np.isnan(self._newest.stamps[i])]
        if not missing:
            return None
        return (
            f"its messages have no joint {some(missing)}; they have {some(self._order.names, most=6) or 'none'}: "
            "give the robot's names in [joints] names, or the scene's joints that it does not measure in unmeasured"
        )

    def _take_joints(self) -> bool:
        heard, newest, changed = self._heard[0], self._newest, False
        for message, _ in self._joints.take():
            try:
                stamp = self._clock.given(message.header.stamp)
                here, position, velocity, _ = self._order.read(message)
            except ValueError as error:
                heard.refuse(str(error))
                continue
            if not len(here):
                heard.refuse(self._lacking() or "a message has no joint of the scene")
                continue
            believed = self._stamps.believes(stamp)
            if believed and newest.overtaken(here, stamp):
                continue
            coordinates, dofs = self._coordinates[here], self._dofs[here]
            lapse = stamp - newest.believed[here]
            told = np.zeros(len(here), dtype=bool) if velocity is None else np.isfinite(velocity)
            if told.any():
                self._qd[dofs[told]] = velocity[told]
            if (later := ~told & (lapse > 0.0)).any():
                self._qd[dofs[later]] = (position[later] - self._before[coordinates[later]]) / lapse[later]
            self._q[coordinates] = position
            newest.stamps[here] = stamp
            if believed:
                self._before[coordinates], newest.believed[here] = position, stamp
            if not heard.count and (lacking := self._lacking()):
                heard.refuse(lacking)
            else:
                heard.note(stamp)
            changed = True
        return changed

    def _take_pose(self, source: _PoseSource) -> bool:
        newest, part, changed = self._newest, source.part, False
        for message, _ in source.inbox.take():
            try:
                found = [(self._clock.given(stamp), link) for stamp, link in source.read(message)]
            except ValueError as error:
                source.heard.refuse(str(error))
                continue
            for stamp, link in found:
                believed = source.stamps.believes(stamp)
                if believed and newest.overtaken(part, stamp):
                    continue
                source.heard.note(stamp)
                source.write(link, stamp - newest.believed[part], self._q, self._qd, self._mocap)
                newest.stamps[part] = stamp
                if believed:
                    source.before, newest.believed[part] = link, stamp
                changed = True
        return changed


class _PoseSource:
    """Poses of a body or of a mocap body."""

    def __init__(
        self,
        connection: Connection,
        pose: PoseTopic,
        name: str,
        part: int,
        world: str,
        *,
        joint=None,
        mocap: int | None = None,
    ):
        several = pose.type is PoseType.TRANSFORMS  # other bodies', too
        self.inbox = Inbox(connection, str(pose.type), pose.topic, depth=DEPTH if several else 1)
        self.heard = Heard(self.inbox.topic, f"{pose.type} of {name}")
        self.part, self._joint, self._mocap = part, joint, mocap
        self._kind, self._frame, self._world = str(pose.type), pose.frame or name, world
        self.stamps = Stamps()
        self.before: Link | None = None
        """The newest link of a time that can be true."""

    def read(self, message: Message) -> Iterator[tuple[Message, Link]]:
        """Stamps and links of a message."""
        return read_links(self._kind, message, self._frame, self._world)

    def write(self, link: Link, lapse: float, q: np.ndarray, qd: np.ndarray, mocap: np.ndarray) -> None:
        """Write a link into coordinates ``[nq]``, velocities ``[nv]`` or mocap poses ``[nm, 7]``.

        Args:
            link: The link.
            lapse: Time since :attr:`before` [s], NaN for the first.
        """
        if self._joint is None:
            mocap[self._mocap] = link.pose
            return
        if link.twist is None and self.before is not None and lapse > 0.0:
            link = Link(link.pose, difference(self.before, link, lapse))
        coordinates, velocities = self._joint.numbers(link)
        q[self._joint.q] = coordinates
        if link.twist is not None or lapse != 0.0:  # two poses of one time tell no velocity
            qd[self._joint.qd] = velocities


WAITING = 200
"""Messages of units and joints that wait between two looks, at most: each carries the estimate forward."""


class Measurements:
    """Measurements, stamped with the time at which they were made; they may be late or out of order.

    Args:
        topics: Which topic tells what.
        connection: The node.
        clock: Turns stamps into seconds.

    Raises:
        ValueError: If a topic's name is none, or the package of its messages is missing.
    """

    def __init__(self, topics: Topics, connection: Connection, clock: RosTime):
        self._clock, self._world = clock, topics.settings.world
        self._sources: list[tuple[Inbox, Heard, Callable[[Message], list[Measurement]]]] = []
        for name, pose in topics.measured.items():
            inbox = Inbox(connection, str(pose.type), pose.topic)
            self._add(inbox, f"{pose.type} of {name}", partial(self._of_pose, name, pose))
        for name, base in topics.bases.items():
            unit = Inbox(connection, "sensor_msgs/Imu", base.imu, depth=WAITING)
            self._add(unit, unit.kind, partial(self._of_unit, name))
            joints = Inbox(connection, "sensor_msgs/JointState", topics.settings.joints.topic, depth=WAITING)
            read = partial(self._of_joints, name, JointOrder(base.joints), len(base.joints))
            self._add(joints, f"{joints.kind} of all joints of {name}, with their efforts", read)

    def _add(self, inbox: Inbox, content: str, read: Callable[[Message], list[Measurement]]) -> None:
        self._sources.append((inbox, Heard(inbox.topic, content), read))

    def heard(self) -> list[Heard]:
        """Messages of each topic; of a silent one its problem says why."""
        for inbox, heard, _ in self._sources:
            if not heard.count and not heard.refused:
                heard.problem = inbox.silence()
        return [heard for _, heard, _ in self._sources]

    def take(self) -> list[Measurement]:
        """Measurements that came since the last call; returns at once."""
        found = []
        for inbox, heard, read in self._sources:
            for message, _ in inbox.take():
                try:
                    told = read(message)
                except ValueError as error:
                    heard.refuse(str(error))
                    continue
                for measured in told:
                    heard.note(measured.time)
                found += told
        return found

    def _of_pose(self, name: str, pose: PoseTopic, message: Message) -> list[Measurement]:
        links = read_links(str(pose.type), message, pose.frame or name, self._world)
        return [PoseMeasured(name, self._clock.given(stamp), link.pose) for stamp, link in links]

    def _of_unit(self, name: str, message: Message) -> list[Measurement]:
        if -1.0 in (message.angular_velocity_covariance[0], message.linear_acceleration_covariance[0]):
            raise ValueError("a message says by a covariance of -1 that it lacks angular velocity or acceleration")
        spin, force = message.angular_velocity, message.linear_acceleration
        gyro, accel = np.array([spin.x, spin.y, spin.z]), np.array([force.x, force.y, force.z])
        return [ImuMeasured(name, self._clock.given(message.header.stamp), gyro, accel)]

    def _of_joints(self, name: str, order: JointOrder, count: int, message: Message) -> list[Measurement]:
        """Measurement of the joints; none where the message is about others."""
        here, position, velocity, effort = order.read(message)
        if not len(here):
            return []
        if len(np.unique(here)) < count:
            raise ValueError(f"a message has joints of {name}, but not all, each once: its base is estimated from all")
        if velocity is None or effort is None:
            lacking = "velocities" if velocity is None else "efforts"
            raise ValueError(f"a message has no {lacking}: the base of {name} is estimated from them")
        q, qd, forces = np.zeros((3, count))
        q[here], qd[here], forces[here] = position, velocity, effort
        return [JointsMeasured(name, self._clock.given(message.header.stamp), q, qd, forces)]
