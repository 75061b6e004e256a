# SPDX-License-Identifier: Apache-2.0
"""Signals that end a program, handled so that what has to be done last is done."""

from __future__ import annotations

import signal
import threading
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from types import FrameType

NAMES = ("SIGINT", "SIGTERM", "SIGHUP")
"""Signals that end a program, where the system has them."""


class Signals:
    """While a block runs, SIGTERM and SIGHUP raise ``SystemExit`` where nobody handles them, instead of ending all.

    The first signal whose handler raises is the last one heard, so that nothing interrupts the ``finally`` clauses;
    :meth:`hold` does that for an end without a signal. What came too late then is heard after the block. Ignored
    signals stay ignored. In other threads than the main one nothing is done: they hear no signals.
    """

    def __init__(self):
        self._held = False
        self._raised = False
        self._late: list[int] = []
        self._before: dict[int, object] = {}

    def __enter__(self) -> Signals:
        if threading.current_thread() is threading.main_thread():
            for number in (getattr(signal, name) for name in NAMES if hasattr(signal, name)):
                before = signal.getsignal(number)
                if callable(before) or before is signal.SIG_DFL:
                    self._before[number] = before
                    signal.signal(number, self._hear)
        return self

    def __exit__(self, *error: object) -> None:
        for number, before in self._before.items():
            signal.signal(number, before)
        if self._late and not self._raised:
            self._end(self._late[0], None)

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
