# SPDX-License-Identifier: Apache-2.0
"""A link that loses, delays and reorders what goes through it, both ways."""

from __future__ import annotations

import heapq
import itertools
import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from warpmpc.loop.estimation.measurement import Measurement
    from warpmpc.loop.robots.safety import Command
    from warpmpc.loop.robots.simulated import Transport
    from warpmpc.scene.model.state import State

OVERTAKEN = 0.01
"""Time that a message comes later for others to overtake it [s]."""


class FaultyLink:
    """A transport behind a link with faults.

    Args:
        transport: The transport.
        delay: Each message is late by a time drawn between these [s], on the robot's clock.
        drop: Share of messages that is lost.
        reorder: Share of messages that come :data:`OVERTAKEN` later, after those behind them.
        seed: Seed of the draws.
        speed: The robot's seconds in a second of wall time.
    """

    def __init__(
        self,
        transport: Transport,
        *,
        delay: tuple[float, float] = (0.0, 0.0),
        drop: float = 0.0,
        reorder: float = 0.0,
        seed: int = 0,
        speed: float = 1.0,
    ):
        self.transport = transport
        self._delay, self._drop, self._reorder, self._speed = delay, drop, reorder, speed
        self._rng = np.random.default_rng([seed, 2])
        self._count = itertools.count()
        self._states: list[tuple[float, int, State]] = []
        self._told: list[tuple[float, int, Sequence[Measurement]]] = []
        self._commands: list[tuple[float, int, Command]] = []

    @property
    def measures(self) -> tuple[type, ...]:
        """Kinds of measurements that the transport sends."""
        return self.transport.measures

    def publish(self, state: State) -> None:
        """Send a state, sooner or later, and those that are due."""
        self._put(self._states, state)
        for due in self._due(self._told):
            self.transport.tell(due)
        for due in self._due(self._states):
            self.transport.publish(due)

    def tell(self, measurements: Sequence[Measurement]) -> None:
        """Send measurements, sooner or later."""
        self._put(self._told, measurements)

    def receive(self, now: float) -> Iterator[Command]:
        """Commands whose time has come."""
        for command in self.transport.receive(now):
            self._put(self._commands, command)
        yield from self._due(self._commands)

    def close(self) -> None:
        """Close the transport."""
        self.transport.close()

    def _put(self, waiting: list[tuple], message: State | Command | Sequence[Measurement]) -> None:
        if self._rng.random() < self._drop:
            return
        late = self._rng.uniform(*self._delay) + OVERTAKEN * (self._rng.random() < self._reorder)
        heapq.heappush(waiting, (time.monotonic() + late / self._speed, next(self._count), message))

    def _due(self, waiting: list[tuple]) -> Iterator:
        now = time.monotonic()
        while waiting and waiting[0][0] <= now:
            yield heapq.heappop(waiting)[2]
