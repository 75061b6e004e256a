# SPDX-License-Identifier: Apache-2.0
"""Threads that share the worlds of a batch between them."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable


class Crew:
    """Runs a function over parts of the worlds on several threads, the calling one among them.

    Warp's CPU kernels and MuJoCo's roll-outs run on the thread that calls them and let Python's lock go meanwhile. Each
    thread takes the next part that is left, so that parts with much contact do not hold up the rest. Threads wait on a
    lock each, which wakes them within about 10 µs; a ``threading.Barrier`` over 16 of them takes a millisecond.

    Args:
        threads: Number of threads.
    """

    def __init__(self, threads: int):
        self.threads = threads
        self._go = [threading.Lock() for _ in range(threads - 1)]
        self._done = threading.Semaphore(0)
        self._work: Callable[[int, int], None] | None = None
        self._errors: list[BaseException] = []
        for index, go in enumerate(self._go, start=1):
            go.acquire()
            threading.Thread(target=self._wait, args=[index, go], daemon=True).start()

    def run(self, parts: int, work: Callable[[int, int], None]) -> None:
        """Call ``work(part, thread)`` once for every part; returns when all are done.

        Raises:
            BaseException: The first error that a part raised.
        """
        helpers = self._go[: max(min(self.threads, parts) - 1, 0)]
        self._next, self._parts, self._work = itertools.count(), parts, work
        for go in helpers:
            go.release()
        self._take(0)
        for _ in helpers:
            self._done.acquire()
        if self._errors:
            errors, self._errors = self._errors, []
            raise errors[0]

    def _take(self, thread: int) -> None:
        """Work on parts until none is left."""
        try:
            for part in self._next:  # one call of a C iterator: no two threads get the same
                if part >= self._parts:
                    return
                self._work(part, thread)
        except BaseException as error:  # raised again by the thread that called
            self._errors.append(error)

    def _wait(self, thread: int, go: threading.Lock) -> None:
        while True:
            go.acquire()
            if self._work is None:
                return
            self._take(thread)
            self._done.release()

    def close(self) -> None:
        """End the threads."""
        self._work = None
        for go in self._go:
            go.release()
        self._go = []
