# SPDX-License-Identifier: Apache-2.0
"""Latest-value buffer: the newest numbers of another process, in shared memory that nobody ever waits for."""

from __future__ import annotations

import zlib
from multiprocessing.context import BaseContext

import numpy as np


class LatestValue:
    """Holds the newest message, an array of numbers; one process writes, others read.

    There is no lock, so that a process that is killed while it writes blocks nobody. Two places take turns, and a
    checksum tells a message that was overwritten while it was read.

    Args:
        context: Context of the processes.
        capacity: Numbers in the longest message.
    """

    def __init__(self, context: BaseContext, capacity: int):
        self._places = [context.RawArray("d", 3 + capacity) for _ in range(2)]  # number, checksum, length, message
        self.capacity = capacity
        self._sent = self._read = 0

    def __getstate__(self) -> dict[str, object]:
        """Without the counts, which are each process's own."""
        return {**self.__dict__, "_sent": 0, "_read": 0}

    def write(self, message: np.ndarray) -> None:
        """Put a message in the place of the older one.

        Raises:
            ValueError: If it is longer than the buffer.
        """
        message = np.ascontiguousarray(message, dtype=float)
        if len(message) > self.capacity:
            raise ValueError(f"a message of {len(message)} numbers does not fit into a buffer of {self.capacity}")
        self._sent = self.sent + 1
        place = np.frombuffer(self._places[self._sent % 2])
        place[0] = 0.0  # nobody may take the older message for whole
        place[3 : 3 + len(message)] = message
        place[1], place[2] = _checksum(message, self._sent), len(message)
        place[0] = self._sent

    @property
    def sent(self) -> int:
        """Messages written so far, by whomever."""
        return max(self._sent, self._newest()[0])

    def read(self) -> np.ndarray | None:
        """The newest message, None where it has been read already or there is none."""
        number, place = self._newest()
        if number <= self._read:
            return None
        copy = place.copy()
        length = int(copy[2])
        message = copy[3 : 3 + length]
        if copy[0] != number or _checksum(message, number) != copy[1]:
            return None  # being written: the next call finds it
        self._read = number
        return message

    def _newest(self) -> tuple[int, np.ndarray]:
        places = [np.frombuffer(place) for place in self._places]
        return max(((int(place[0]), place) for place in places), key=lambda found: found[0])


def _checksum(message: np.ndarray, number: int) -> int:
    return zlib.crc32(message.tobytes(), number & 0xFFFFFFFF)
