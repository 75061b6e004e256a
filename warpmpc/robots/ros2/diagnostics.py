# SPDX-License-Identifier: Apache-2.0
"""Diagnostics of the planner as a ROS message."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from rclpy.clock import Clock
from rclpy.clock_type import ClockType

from .connection import Connection, message_class

if TYPE_CHECKING:
    from ...realtime.agent import Fault
    from ...realtime.messages import TimedPlan

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
