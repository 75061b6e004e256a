# SPDX-License-Identifier: Apache-2.0
"""Signals that end a program, handled so that what has to be done last is done."""

from __future__ import annotations

import os
import signal
import threading
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from types import FrameType

NAMES = (
    "SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGALRM", "SIGVTALRM", "SIGPROF", "SIGUSR1", "SIGUSR2", "SIGXCPU",
    "SIGXFSZ", "SIGPOLL", "SIGPWR", "SIGSTKFLT", "SIGPIPE",
)  # fmt: skip
"""Signals that end a program and can be handled, where the system has them; real-time signals besides."""
STOPS = ("SIGTSTP", "SIGTTIN", "SIGTTOU")
"""Signals that stop a program and can be handled: Ctrl-Z, and the terminal of a program in the background."""


class Signals:
    """While a block runs, signals of :data:`NAMES` raise ``SystemExit`` where nobody handles them, not ending all.

    The first signal whose handler raises is the last one heard, so that nothing interrupts the ``finally`` clauses;
    :meth:`hold` does that for an end without a signal. What came too late then is heard after the block. Ignored
    signals stay ignored. Signals of :data:`STOPS` are noted: :meth:`suspend` stops the program. In other threads than
    the main one nothing is done: they hear no signals.
    """

    def __init__(self):
        self._held = False
        self._raised = False
        self._late: list[int] = []
        self._before: dict[int, object] = {}
        self.stopped = False
        """Whether a signal came that stops the program, and :meth:`suspend` was not called since."""

    def __enter__(self) -> Signals:
        if threading.current_thread() is threading.main_thread():
            for number in (*_numbers(NAMES), *range(signal.SIGRTMIN, signal.SIGRTMAX + 1)):
                self._handle(number, self._hear)
            for number in _numbers(STOPS):
                if signal.getsignal(number) is signal.SIG_DFL:
                    self._handle(number, self._note_stop)
        return self

    def __exit__(self, *error: object) -> None:
        for number, before in self._before.items():
            signal.signal(number, before)
        if self._late and not self._raised:
            self._end(self._late[0], None)

    def _handle(self, number: int, handler: Callable[[int, FrameType | None], None]) -> None:
        before = signal.getsignal(number)
        if callable(before) or before is signal.SIG_DFL:
            self._before[number] = before
            signal.signal(number, handler)

    def suspend(self) -> None:
        """Stop the program; returns once it is continued."""
        os.kill(os.getpid(), signal.SIGSTOP)
        self.stopped = False

    def _note_stop(self, number: int, frame: FrameType | None) -> None:
        self.stopped = True

    def hold(self) -> None:
        """Hear no more signals until the end of the block."""
        self._held = True

    def _hear(self, number: int, frame: FrameType | None) -> None:
        if self._held:
            self._late.append(number)
            return
        try:
            self._end(number, frame)
        except BaseException:
            self._held = self._raised = True
            raise

    def _end(self, number: int, frame: FrameType | None) -> None:
        """Handle the signal as without us, but for ending the program on the spot."""
        before = self._before[number]
        if not callable(before):
            raise SystemExit(128 + number)
        before(number, frame)


def _numbers(names: Sequence[str]) -> list[int]:
    """Numbers of the signals that the system has."""
    return [int(getattr(signal, name)) for name in names if hasattr(signal, name)]
