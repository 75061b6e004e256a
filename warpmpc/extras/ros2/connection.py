# SPDX-License-Identifier: Apache-2.0
"""A ROS 2 node, its executor in a thread, and subscriptions that are read when the robot's loop has time for them."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from itertools import takewhile
from typing import Any

import rclpy
from rclpy.callback_groups import CallbackGroup
from rclpy.context import Context
from rclpy.exceptions import InvalidNamespaceException, InvalidNodeNameException, InvalidTopicNameException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions

DEPTH = 10
"""Messages that wait between two looks, at most, where nothing else is said; older ones are dropped."""
LARGEST = 65536
"""Size of all messages of a topic that are read at a look, at most [bytes]: a trajectory of some hundred points."""
MOST = 32
"""Messages of a topic that are read at a look, at most: each takes some ten microseconds."""
LONG, REST = 2e-3, 3.0
"""Time that a look at a topic may take [s]; after one that took longer the topic rests for a multiple of its time."""
SWITCH = 2e-4
"""Time for which a thread may keep Python's lock while another one waits [s]."""
CLOSING = 2.0
"""Wall time for which the executor's thread is waited for [s]."""


def message_class(kind: str) -> type:
    """The class of a message type.

    Args:
        kind: ``package/Name``.

    Raises:
        ValueError: If its package is missing.
    """
    package, _, name = kind.partition("/")
    try:
        return getattr(import_module(f"{package}.msg"), name)
    except ModuleNotFoundError:
        found = "PyPI has none" if package == "tf2_msgs" else f"or pip install ros-{package.replace('_', '-')}"
        raise ValueError(f"needs the ROS package {package}: source a ROS 2 that has it; {found}") from None


class _Polled(CallbackGroup):
    """Subscriptions that no executor waits for."""

    def can_execute(self, entity: object) -> bool:
        return False

    def beginning_execution(self, entity: object) -> bool:
        return False

    def ending_execution(self, entity: object) -> None:
        """Do nothing."""


class Inbox:
    """Messages of a topic, taken on request; an executor would spend more on each than there is time in a tick.

    Args:
        connection: The node.
        kind: Message type, ``package/Name``.
        topic: Topic, in the node's namespace where it is relative.
        reliable: Whether what is lost on the way is sent again; sensors' messages are not.
        depth: Messages that wait between two looks, at most; one where the newest tells everything.
    """

    def __init__(self, connection: Connection, kind: str, topic: str, *, reliable: bool = False, depth: int = DEPTH):
        self.kind, self._node, self._depth = kind, connection.node, depth
        reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        qos = QoSProfile(depth=depth, reliability=reliability)
        with _names(topic):
            self._subscription = self._node.create_subscription(
                message_class(kind), topic, _nothing, qos, callback_group=connection.polled
            )
        self.topic = self._subscription.topic_name
        self._rests = 0.0  # until when, on the monotonic clock [s]

    def take(self) -> Iterator[tuple[Any, str]]:
        """Messages that came since the last call and who sent them, in their order; at most as many as may wait.

        Of more than :data:`MOST` some are left out, evenly; of more than :data:`LARGEST` bytes the older ones. A single
        one of more bytes is empty. After a look that took :data:`LONG`, with what is done about each, there are none
        for a while.
        """
        begin = time.monotonic()
        if begin < self._rests:
            return
        handle, kind = self._subscription.handle, self._subscription.msg_type
        taken = (handle.take_message(kind, True) for _ in range(self._depth))
        waiting = list(takewhile(lambda found: found is not None, taken))
        if (count := len(waiting)) > MOST:
            waiting = [waiting[(k + 1) * count // MOST - 1] for k in range(MOST)]
        sizes = [len(message) if len(message) <= LARGEST else 0 for message, _ in waiting]
        while sum(sizes) > LARGEST:
            del sizes[0], waiting[0]
        for message, info in waiting:
            yield deserialize_message(message, kind) if len(message) <= LARGEST else kind(), sender(info)
        took = time.monotonic() - begin
        if took > LONG:
            self._rests = begin + (1.0 + REST) * took

    def silence(self) -> str:
        """A sentence about what may keep messages from coming."""
        there = self._node.get_publishers_info_by_topic(self.topic)
        kinds = {info.topic_type.replace("/msg/", "/") for info in there}
        if not there:
            return f"nobody publishes {self.topic} ({self.kind}): start it, name its topic, or set ROS_DOMAIN_ID alike"
        if self.kind not in kinds:
            return f"{self.topic} has {', '.join(sorted(kinds))}, not {self.kind}: set the type, or another topic"
        return f"{self.topic} has a publisher, but no message came: does it run?"


class Connection:
    """A node with its own context, so that others in this process do not mind.

    Args:
        node: Its name.
        namespace: Its namespace.
        use_sim_time: Whether its clock is ``/clock``.

    Raises:
        ValueError: If a name is none.
    """

    def __init__(self, node: str, namespace: str = "", *, use_sim_time: bool = False):
        self._context, self.polled = Context(), _Polled()
        rclpy.init(args=[], context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        try:
            with _names(f"{namespace}/{node}"):
                self.node = rclpy.create_node(
                    node,
                    namespace=namespace,
                    context=self._context,
                    enable_rosout=False,
                    parameter_overrides=[Parameter("use_sim_time", value=use_sim_time)],
                )
        except ValueError:
            rclpy.shutdown(context=self._context)
            raise
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, name="ROS 2", daemon=True)

    def start(self) -> None:
        """Start the executor's thread; Python's lock changes hands soon, for the robot's loop waits for it."""
        sys.setswitchinterval(min(SWITCH, sys.getswitchinterval()))
        self._thread.start()

    def publisher(self, kind: str, topic: str) -> Any:
        """A publisher of the newest message, to subscriptions of any reliability.

        Args:
            kind: Message type, ``package/Name``.
            topic: Topic, in the node's namespace where it is relative.
        """
        with _names(topic):
            return self.node.create_publisher(message_class(kind), topic, QoSProfile(depth=1))

    def close(self) -> None:
        """End the executor's thread and the node."""
        self._executor.shutdown(timeout_sec=CLOSING)
        if self._thread.is_alive():
            self._thread.join(CLOSING)
        self.node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def _spin(self) -> None:
        with suppress(ExternalShutdownException):
            self._executor.spin()


@contextmanager
def _names(name: str) -> Iterator[None]:
    """Turn rclpy's errors about a name into one line."""
    try:
        yield
    except (InvalidTopicNameException, InvalidNamespaceException, InvalidNodeNameException) as error:
        raise ValueError(f"'{name}' is no ROS name: {' '.join(str(error).split())}") from None


def sender(info: dict[str, Any]) -> str:
    """The sender of a message as rclpy identifies it; the same for all in versions that do not."""
    return info["publisher_gid"]["data"].hex() if info.get("publisher_gid") else ""


def _nothing(message: object) -> None:
    """Take no message: they are asked for."""
