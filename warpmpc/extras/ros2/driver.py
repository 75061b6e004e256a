# SPDX-License-Identifier: Apache-2.0
"""The driver of robots behind ROS 2 topics.

The task by ROS: poses on topics, weights and scalars as parameters.

Diagnostics of the planner as a ROS message.

Paths of rollouts as ROS markers.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock
from rclpy.clock_type import ClockType

from ...loop.estimation.measurement import ImuMeasured, JointsMeasured, PoseMeasured
from ...loop.robots.sources import Heard
from ...planner.controller.rollout_paths import BEST_COLOR
from ...scene.task.task import Task
from .commands import CommandCodec
from .connection import DEPTH, Connection, Inbox, message_class
from .messages import RosTime, read_links
from .observer import Measurements, Observer
from .settings import PoseType
from .topics import Topics

if TYPE_CHECKING:
    from ...loop.estimation.measurement import Measurement
    from ...loop.realtime.agent import Fault
    from ...loop.realtime.messages import TimedPlan
    from ...planner.controller.rollout_paths import RolloutPaths
    from ...planner.plan import Plan
    from ...scene.model.compiled import CompiledScene
    from ...scene.model.state import State
    from ...scene.schema import Scene
    from .settings import Ros2Settings

ROLLOUT_MARKERS_PERIOD = 0.2
"""Wall time between two messages [s]."""
LIFETIME = 1
"""Time after which a viewer forgets a marker [s]."""
POINTS = 16
"""Points of a path, at most: messages hold Python's lock while they are made."""
OTHERS = 8
"""Sampled rollouts that are shown, at most, for the same reason."""
WIDTH, BEST_WIDTH = 0.004, 0.01
"""Widths of lines [m]."""


class RolloutMarkers:
    """Publishes paths of rollouts in the executor's thread, while there are subscribers.

    Args:
        connection: The node.
        topic: Topic of visualization_msgs/MarkerArray.
        world: Frame of the scene's world.

    Raises:
        ValueError: If the topic's name is none, or the package of its messages is missing.
    """

    def __init__(self, connection: Connection, topic: str, world: str):
        self._array, self._marker = (message_class(f"visualization_msgs/{name}") for name in ("MarkerArray", "Marker"))
        self._point = message_class("geometry_msgs/Point")
        self._publisher = connection.publisher("visualization_msgs/MarkerArray", topic)
        self._node, self._world, self._heard = connection.node, world, False

    def follow(self, source: Callable[[], RolloutPaths | None]) -> None:
        """Publish what a function finds, such as :meth:`~warpmpc.PlannerProcess.paths`."""
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._node.create_timer(ROLLOUT_MARKERS_PERIOD, lambda: self._publish(source), clock=clock)

    def _publish(self, source: Callable[[], RolloutPaths | None]) -> None:
        heard, self._heard = self._heard, self._publisher.get_subscription_count() > 0
        paths = source() if self._heard else None
        if heard and paths is not None:  # what is found first may be from an earlier subscription
            self._publisher.publish(self._array(markers=list(self._markers(paths))))

    def _markers(self, paths: RolloutPaths) -> Iterator[Any]:
        """A line for each frame of the cheapest rollout, then of others from cheap to costly."""
        for frame, path in enumerate(paths.best):
            yield self._line("best", frame, path, BEST_COLOR, BEST_WIDTH)
        chosen = np.unique(np.linspace(0, len(paths.others) - 1, min(OTHERS, len(paths.others))).astype(int))
        for i in chosen:
            for frame, path in enumerate(paths.others[i]):
                yield self._line("sampled", int(i) * len(paths.best) + frame, path, paths.colors[i], WIDTH)

    def _line(self, space: str, number: int, path: np.ndarray, color: np.ndarray, width: float) -> Any:
        marker = self._marker(ns=space, id=number, type=self._marker.LINE_STRIP, action=self._marker.ADD)
        marker.header.frame_id = self._world
        marker.lifetime.sec, marker.pose.orientation.w, marker.scale.x = LIFETIME, 1.0, width
        red, green, blue = (float(channel) / 255.0 for channel in color)
        marker.color.r, marker.color.g, marker.color.b, marker.color.a = red, green, blue, 1.0
        kept = np.unique(np.linspace(0, len(path) - 1, min(POINTS, len(path))).astype(int))
        marker.points = [self._point(x=x, y=y, z=z) for x, y, z in path[kept].tolist()]
        return marker


PERIOD = 0.5
"""Wall time between two messages [s]."""


class Diagnostics:
    """Publishes how plans come, in the executor's thread, from what the robot's loop notes at every tick.

    Args:
        connection: The node.
        topic: Topic of diagnostic_msgs/DiagnosticArray.
        scene: Name of the scene.

    Raises:
        ValueError: If the topic's name is none, or the package of its messages is missing.
    """

    def __init__(self, connection: Connection, topic: str, scene: str):
        self._array, self._status, self._value = (
            message_class(f"diagnostic_msgs/{name}") for name in ("DiagnosticArray", "DiagnosticStatus", "KeyValue")
        )
        self._publisher = connection.publisher("diagnostic_msgs/DiagnosticArray", topic)
        self._node, self._name = connection.node, f"{connection.node.get_name()}: {scene}"
        self._noted: tuple[TimedPlan | None, float, Fault | None] | None = None
        self._before: tuple[int, float] | None = None  # number of the newest plan at the last message, and when
        connection.node.create_timer(PERIOD, self._publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def note(self, timed: TimedPlan | None, *, now: float, fault: Fault | None) -> None:
        """Take note of a tick; returns at once.

        Args:
            timed: The newest plan, None before the first.
            now: The robot's clock [s].
            fault: The fault that lasts, None where the plan is followed.
        """
        self._noted = timed, now, fault

    def _publish(self) -> None:
        if self._noted is None:
            return
        timed, now, fault = self._noted
        array, status = self._array(), self._status()
        array.header.stamp = self._node.get_clock().now().to_msg()
        status.name, status.level = self._name, status.OK if fault is None else status.WARN
        status.message = "following plans" if fault is None else f"sending the safe command: {fault.why}"
        if timed is None:
            status.level, status.message = status.WARN, "there is no plan yet"
        else:
            values = {
                "plans": timed.number + 1,
                "rate [Hz]": self._rate(timed.number),
                "latency [ms]": 1e3 * timed.latency,
                "planning [ms]": timed.plan_ms,
                "age of its observation [ms]": 1e3 * (now - timed.observed),
                "effective samples": timed.eta,
            }
            status.values = [self._value(key=key, value=f"{value:.4g}") for key, value in values.items()]
        array.status.append(status)
        self._publisher.publish(array)

    def _rate(self, number: int) -> float:
        """Plans in a second since the last message [Hz]; NaN at the first."""
        before, self._before = self._before, (number, time.monotonic())
        return float("nan") if before is None else (number - before[0]) / (self._before[1] - before[1])


LARGEST = float(np.finfo(np.float32).max)
"""Largest weight or scalar that a task has."""


class TaskInputs:
    """Changes a task between plans.

    Args:
        task: The task.
        topics: Topics of its poses.
        connection: The node; its parameters are ``weight.TERM`` of each cost term and ``scalar.NAME`` of each scalar.

    Raises:
        ValueError: If a topic's name is none, or the package of its messages is missing.
    """

    heard: list[Heard]
    """Messages of each topic."""

    def __init__(self, task: Task, topics: Topics, connection: Connection):
        self._task, self._clock = task, RosTime()
        self._poses, self._world = list(topics.task.values()), topics.settings.world
        self._inboxes = [
            Inbox(connection, str(p.type), p.topic, reliable=True, depth=DEPTH if p.type is PoseType.TRANSFORMS else 1)
            for p in self._poses
        ]
        self.heard = [Heard(inbox.topic, f"{inbox.kind} of {pose.name}") for inbox, pose in self._of_poses()]
        names = {"scalar": task.scalar_name, "weight": task.weight_name}
        self._parameters = {f"{kind}.{name}": name for kind, some in names.items() for name in some}
        for parameter, name in self._parameters.items():
            connection.node.declare_parameter(parameter, float(task[name]))
        connection.node.add_on_set_parameters_callback(self._set)
        self._changes: dict[str, float] = {}

    def take(self) -> None:
        """Change the task by what came since the last call; returns at once."""
        for name in list(self._changes):
            self._task[name] = self._changes.pop(name)
        for inbox, pose, heard in zip(self._inboxes, self._poses, self.heard, strict=True):
            for message, _ in inbox.take():
                try:
                    for stamp, link in read_links(inbox.kind, message, pose.frame or pose.name, self._world):
                        self._task[pose.name] = link.pose
                        heard.note(self._clock.seconds(stamp))
                except ValueError as error:
                    heard.refuse(str(error))

    def _set(self, parameters: Sequence[Any]) -> SetParametersResult:
        """Take note of parameters, in the executor's thread."""
        ours = [(self._parameters[p.name], p) for p in parameters if p.name in self._parameters]
        for _, parameter in ours:
            if not abs(parameter.value) <= LARGEST:  # true of NaN, too
                reason = f"{parameter.name} is a finite number of single precision, not {parameter.value}"
                return SetParametersResult(successful=False, reason=reason)
        self._changes.update((name, float(parameter.value)) for name, parameter in ours)
        return SetParametersResult(successful=True)

    def _of_poses(self) -> Any:
        return zip(self._inboxes, self._poses, strict=True)


REPEAT = 0.04
"""Time after which a plan is sent again while there is no other [s]."""


class Ros2Robot:
    """A robot whose joints and bodies are heard on topics, and that is commanded on one.

    Messages are taken in :meth:`observe`, which never waits. Only what may come late, parameters and what is told of
    the planner, is in the executor's thread.

    Args:
        scene: The scene.
        task: The task, whose poses are heard on topics and whose weights and scalars are parameters; a new one if
            None.
        compiled: The scene, compiled.
        settings: Topics.
        config: File of the settings, for errors.

    Raises:
        SceneError: If the settings do not fit the scene.
        ValueError: If a topic's name is none, or the package of its messages is missing.
    """

    measures = (PoseMeasured, ImuMeasured, JointsMeasured)
    """Kinds of its measurements."""

    def __init__(
        self,
        scene: Scene,
        *,
        task: Task | None = None,
        compiled: CompiledScene,
        settings: Ros2Settings,
        config: Path | None = None,
        **_: object,
    ):
        self.connect_timeout, self.use_sim_time = settings.connect_timeout, settings.use_sim_time
        layout, clock, task = compiled.layout, RosTime(), Task(scene) if task is None else task
        topics = Topics.of(layout, settings, task, config, estimated=scene.estimate, bases=scene.estimate_base)
        self._codec = CommandCodec(layout, settings.command, clock, config)
        if self._codec.takes_plans:
            self.follow = self._follow
        self._connection = Connection(settings.node, settings.namespace, use_sim_time=settings.use_sim_time)
        try:
            self._observer = Observer(layout, topics, self._connection, clock)
            self._measured = Measurements(topics, self._connection, clock)
            self._inputs = TaskInputs(task, topics, self._connection)
            self._commands = self._connection.publisher(str(settings.command.type), settings.command.topic)
            rollouts = self._rollouts(settings)
            self._diagnostics = Diagnostics(self._connection, settings.diagnostics, scene.name)
        except ValueError:
            self._connection.close()
            raise
        self.tell = self._diagnostics.note
        if rollouts is not None:
            self.show_paths = rollouts.follow
        self._control_dt = scene.timing.control_dt
        self._state: State | None = None
        self._plan: Plan | None = None
        self._sent = 0.0
        self._connection.start()

    def _rollouts(self, settings: Ros2Settings) -> RolloutMarkers | None:
        """Markers of rollouts; None where their package is missing, which others than PyPI may lack."""
        try:
            return RolloutMarkers(self._connection, settings.rollouts, settings.world)
        except ValueError:
            if find_spec("visualization_msgs") is None:
                return None
            raise

    def heard(self) -> list[Heard]:
        """Messages of each topic that the state needs, and of those of the task that spoke."""
        needed = [*self._observer.heard(), *self._measured.heard()]
        return [*needed, *(heard for heard in self._inputs.heard if heard.count or heard.refused)]

    def observe(self) -> State | None:
        """The newest state, None before every part of it was heard."""
        self._inputs.take()
        self._state = self._observer.observe()
        return self._state

    def measurements(self) -> list[Measurement]:
        """Measurements that came since the last call."""
        return self._measured.take()

    def apply(self, control: np.ndarray) -> None:
        """Send a control ``[nu]``."""
        self._plan = None
        self._commands.publish(self._codec.write(control, self._state.time, self._state.joint_q))

    def _follow(self, plan: Plan, now: float) -> None:
        """Send a plan's next controls: once, and again for a robot that waits for commands.

        Args:
            plan: The plan.
            now: The robot's clock [s].
        """
        if plan is not self._plan or now - self._sent >= REPEAT:
            self._plan, self._sent = plan, now
            self._commands.publish(self._codec.write_plan(plan, now, self._state.time, self._control_dt))

    def close(self) -> None:
        """End the node."""
        self._connection.close()
