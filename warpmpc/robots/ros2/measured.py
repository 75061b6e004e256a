# SPDX-License-Identifier: Apache-2.0
"""Measured poses of things that a scene estimates, from their topics."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...estimation.measurement import PoseMeasured
from ..heard import Heard
from .connection import Connection, Inbox
from .messages import RosTime, read_links

if TYPE_CHECKING:
    from .topics import Topics


class MeasuredPoses:
    """Measured poses, stamped with the time at which they were measured; they may be late or out of order.

    Args:
        topics: Which topic tells what.
        connection: The node.
        clock: Turns stamps into seconds.

    Raises:
        ValueError: If a topic's name is none, or the package of its messages is missing.
    """

    def __init__(self, topics: Topics, connection: Connection, clock: RosTime):
        self._clock, self._world = clock, topics.settings.world
        self._sources = []
        for name, pose in topics.measured.items():
            inbox = Inbox(connection, str(pose.type), pose.topic)
            self._sources.append((name, pose, inbox, Heard(inbox.topic, f"{pose.type} of {name}")))

    def heard(self) -> list[Heard]:
        """Messages of each topic; of a silent one its problem says why."""
        for _, _, inbox, heard in self._sources:
            if not heard.count and not heard.refused:
                heard.problem = inbox.silence()
        return [heard for *_, heard in self._sources]

    def take(self) -> list[PoseMeasured]:
        """Poses that came since the last call; returns at once."""
        found = []
        for name, pose, inbox, heard in self._sources:
            for message, _ in inbox.take():
                try:
                    links = read_links(str(pose.type), message, pose.frame or name, self._world)
                    told = [PoseMeasured(name, self._clock.given(stamp), link.pose) for stamp, link in links]
                except ValueError as error:
                    heard.refuse(str(error))
                    continue
                for measured in told:
                    heard.note(measured.time)
                found += told
        return found
