# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C and SIGTERM at any time, whatever runs."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time
from contextlib import suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)
PATIENCE = 3.0
"""Time that native code may hold up a signal [s]."""
TOGETHER = 1.0
"""Signals so soon after one that has ended what ran are one with it: files are being closed [s]."""


class Interrupts:
    """Ctrl-C and SIGTERM that cannot get lost; both raise ``KeyboardInterrupt``.

    Native code that calls back into Python may swallow a ``KeyboardInterrupt``: pydantic's serializer turns one into a
    warning. So it is also written down, and raised again by :meth:`check`; below pydantic it is only written down.
    Native code that does not call back holds it up: a plan that takes minutes ends the process :data:`PATIENCE` later.
    A shell lets what it starts in the background ignore SIGINT; that does not count here.
    """

    def __init__(self):
        self._number: int | None = None
        self._raised = -TOGETHER
        self._noted = threading.Event()

    def __enter__(self) -> Interrupts:
        self._wakeup = socket.socketpair()
        self._wakeup[1].setblocking(False)
        self._before = {number: signal.signal(number, self._note) for number in SIGNALS}
        self._fd_before = signal.set_wakeup_fd(self._wakeup[1].fileno(), warn_on_full_buffer=False)
        threading.Thread(target=self._watch, args=(self._wakeup[0],), daemon=True).start()
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler or signal.SIG_DFL)
        signal.set_wakeup_fd(self._fd_before)
        self._noted.set()
        for end in self._wakeup:
            end.close()

    @property
    def code(self) -> int:
        """Exit code of a program that a signal has ended: 130 for Ctrl-C, 143 for SIGTERM."""
        return _code(self._number or signal.SIGINT)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._number = self._number or number
        self._noted.set()
        now = time.monotonic()
        if now - self._raised < TOGETHER:
            return
        while frame is not None:
            if frame.f_globals.get("__name__", "").startswith("pydantic."):
                return
            frame = frame.f_back
        self._raised = now
        raise KeyboardInterrupt

    def _watch(self, wakeup: socket.socket) -> None:
        """Wait for a signal, and for the main thread to take note of it; in a separate thread."""
        with suppress(OSError):  # closed when it is over
            while numbers := wakeup.recv(64):
                found = [number for number in numbers if number in SIGNALS]
                if not found:
                    continue
                if not self._noted.wait(PATIENCE):
                    if sys.stderr.isatty():
                        os.write(2, b"\x1b[?25h\n")  # a bar hides the cursor
                    os._exit(_code(found[0]))
                self._noted.clear()  # the next one may come while native code runs
                wakeup.setblocking(False)
                with suppress(BlockingIOError):
                    wakeup.recv(64)  # presses before the note was taken are noted with it
                wakeup.setblocking(True)

    def check(self) -> None:
        """Raise ``KeyboardInterrupt`` if a signal came."""
        if self._number is not None:
            raise KeyboardInterrupt


def _code(number: int) -> int:
    """Exit code of a program that a signal ended, as shells tell it."""
    return 128 + number
