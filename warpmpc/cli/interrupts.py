# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C at any time, whatever runs."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
from contextlib import suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from types import FrameType

INTERRUPTED = 130
"""Exit code of an interrupted run."""
PATIENCE = 3.0
"""How long native code may hold up Ctrl-C [s]."""


class Interrupts:
    """Ctrl-C that cannot get lost.

    Native code that calls back into Python may swallow a ``KeyboardInterrupt``: pydantic's serializer turns one into a
    warning. So it is also written down, and raised again by :meth:`check`; below pydantic it is only written down.
    Native code that does not call back holds it up: a plan that takes minutes ends the process :data:`PATIENCE` later.
    """

    def __init__(self):
        self._pressed = False
        self._noted = threading.Event()
        self._wakeup: tuple[socket.socket, socket.socket] | None = None

    def __enter__(self) -> Interrupts:
        self._before = signal.getsignal(signal.SIGINT)
        if self._before is signal.default_int_handler:
            signal.signal(signal.SIGINT, self._note)
            self._wakeup = socket.socketpair()
            self._wakeup[1].setblocking(False)
            self._fd_before = signal.set_wakeup_fd(self._wakeup[1].fileno(), warn_on_full_buffer=False)
            threading.Thread(target=self._watch, args=(self._wakeup[0],), daemon=True).start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._before is signal.default_int_handler:
            signal.signal(signal.SIGINT, self._before)
            signal.set_wakeup_fd(self._fd_before)
            self._noted.set()
            for end in self._wakeup:
                end.close()

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._pressed = True
        self._noted.set()
        while frame is not None:
            if frame.f_globals.get("__name__", "").startswith("pydantic."):
                return
            frame = frame.f_back
        raise KeyboardInterrupt

    def _watch(self, wakeup: socket.socket) -> None:
        """Wait for a signal, and for the main thread to take note of it; in a thread of its own."""
        with suppress(OSError):  # closed when it is over
            while numbers := wakeup.recv(64):
                if signal.SIGINT not in numbers:
                    continue
                if not self._noted.wait(PATIENCE):
                    if sys.stderr.isatty():
                        os.write(2, b"\x1b[?25h\n")  # a bar hides the cursor
                    os._exit(INTERRUPTED)
                self._noted.clear()  # the next one may come while native code runs
                wakeup.setblocking(False)
                with suppress(BlockingIOError):
                    wakeup.recv(64)  # presses before the note was taken are noted with it
                wakeup.setblocking(True)

    def check(self) -> None:
        """Raise ``KeyboardInterrupt`` if Ctrl-C was pressed."""
        if self._pressed:
            raise KeyboardInterrupt
