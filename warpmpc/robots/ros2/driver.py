# SPDX-License-Identifier: Apache-2.0
"""The driver of robots behind ROS 2 topics."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from ...estimation.measurement import ImuMeasured, JointsMeasured, PoseMeasured
from ...task.task import Task
from .commands import CommandCodec
from .connection import Connection
from .diagnostics import Diagnostics
from .measured import Measurements
from .messages import RosTime
from .observer import Observer
from .rollout_markers import RolloutMarkers
from .task_inputs import TaskInputs
from .topics import Topics

if TYPE_CHECKING:
    import numpy as np

    from ...estimation.measurement import Measurement
    from ...model.compiled import CompiledScene
    from ...model.state import State
    from ...planner.plan import Plan
    from ...scene.schema import Scene
    from ..heard import Heard
    from .settings import Ros2Settings

REPEAT = 0.04
"""Time after which a plan is sent again while there is no other [s]."""


class Ros2Robot:
    """A robot whose joints and bodies are heard on topics, and that is commanded on one.

    Messages are taken in :meth:`observe`, which never waits. Only what may come late, parameters and what is told of
    the planner, is in the executor's thread.

    Args:
        scene: The scene.
        task: The task, whose poses are heard on topics and whose weights and scalars are parameters; one of its own if
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
