# SPDX-License-Identifier: Apache-2.0
"""Paths of rollouts as ROS markers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from rclpy.clock import Clock
from rclpy.clock_type import ClockType

from ...controller.rollout_paths import BEST_COLOR
from .connection import Connection, message_class

if TYPE_CHECKING:
    from ...controller.rollout_paths import RolloutPaths

PERIOD = 0.2
"""Wall time between two messages [s]."""
LIFETIME = 1
"""Time after which a viewer forgets a marker [s]."""
POINTS = 16
"""Points of a path, at most: messages hold Python's lock while they are made."""
OTHERS = 8
"""Sampled rollouts that are shown, at most, likewise."""
WIDTH, BEST_WIDTH = 0.004, 0.01
"""Widths of lines [m]."""


class RolloutMarkers:
    """Publishes paths of rollouts in the executor's thread, while somebody listens.

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
        self._node.create_timer(PERIOD, lambda: self._publish(source), clock=clock)

    def _publish(self, source: Callable[[], RolloutPaths | None]) -> None:
        heard, self._heard = self._heard, self._publisher.get_subscription_count() > 0
        paths = source() if self._heard else None
        if heard and paths is not None:  # what is found first may be from when somebody listened before
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
