# SPDX-License-Identifier: Apache-2.0
"""The task by ROS: poses on topics, weights and scalars as parameters."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from rcl_interfaces.msg import SetParametersResult

from ..heard import Heard
from .connection import Connection, Inbox
from .messages import RosTime, read_links

if TYPE_CHECKING:
    from ...task.task import Task
    from .topics import Topics

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
        self._inboxes = [Inbox(connection, str(pose.type), pose.topic, reliable=True) for pose in self._poses]
        self.heard = [Heard(inbox.topic, f"{inbox.kind} of {pose.name}") for inbox, pose in self._of_poses()]
        names = {"scalar": task.scalar_name, "weight": task.weight_name}
        self._parameters = {f"{kind}.{name}": name for kind, some in names.items() for name in some}
        for parameter, name in self._parameters.items():
            connection.node.declare_parameter(parameter, float(task[name]))
        connection.node.add_on_set_parameters_callback(self._set)
        self._changes: deque[tuple[str, float]] = deque()

    def take(self) -> None:
        """Change the task by what came since the last call; returns at once."""
        while self._changes:
            name, value = self._changes.popleft()
            self._task[name] = value
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
        self._changes.extend((name, float(parameter.value)) for name, parameter in ours)
        return SetParametersResult(successful=True)

    def _of_poses(self) -> Any:
        return zip(self._inboxes, self._poses, strict=True)
