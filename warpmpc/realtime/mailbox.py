# SPDX-License-Identifier: Apache-2.0
"""The newest numbers of another process, in shared memory that nobody ever waits for."""

from __future__ import annotations

import zlib
from multiprocessing.context import BaseContext

import numpy as np


class Mailbox:
    """Holds the newest letter, an array of numbers; one process writes, others read.

    There is no lock, so that a process that is killed while it writes blocks nobody. Two places take turns, and a
    checksum tells a letter that was overwritten while it was read.

    Args:
        context: Context of the processes.
        capacity: Numbers in the longest letter.
    """

    def __init__(self, context: BaseContext, capacity: int):
        self._places = [context.RawArray("d", 3 + capacity) for _ in range(2)]  # number, checksum, length, letter
        self.capacity = capacity
        self._sent = self._read = 0

    def __getstate__(self) -> dict[str, object]:
        """Without the counts, which are each process's own."""
        return {**self.__dict__, "_sent": 0, "_read": 0}

    def write(self, letter: np.ndarray) -> None:
        """Put a letter in the place of the older one.

        Raises:
            ValueError: If it is longer than the mailbox.
        """
        letter = np.ascontiguousarray(letter, dtype=float)
        if len(letter) > self.capacity:
            raise ValueError(f"a letter of {len(letter)} numbers does not fit into a mailbox of {self.capacity}")
        self._sent = self.sent + 1
        place = np.frombuffer(self._places[self._sent % 2])
        place[0] = 0.0  # nobody may take the older letter for whole
        place[3 : 3 + len(letter)] = letter
        place[1], place[2] = _checksum(letter, self._sent), len(letter)
        place[0] = self._sent

    @property
    def sent(self) -> int:
        """Letters written so far, by whomever."""
        return max(self._sent, self._newest()[0])

    def read(self) -> np.ndarray | None:
        """The newest letter, None where it has been read already or there is none."""
        number, place = self._newest()
        if number <= self._read:
            return None
        copy = place.copy()
        length = int(copy[2])
        letter = copy[3 : 3 + length]
        if copy[0] != number or _checksum(letter, number) != copy[1]:
            return None  # being written: the next call finds it
        self._read = number
        return letter

    def _newest(self) -> tuple[int, np.ndarray]:
        places = [np.frombuffer(place) for place in self._places]
        return max(((int(place[0]), place) for place in places), key=lambda found: found[0])


def _checksum(letter: np.ndarray, number: int) -> int:
    return zlib.crc32(letter.tobytes(), number & 0xFFFFFFFF)
