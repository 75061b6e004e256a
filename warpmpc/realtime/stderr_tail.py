# SPDX-License-Identifier: Apache-2.0
"""Tail of a process's standard error, kept for the case that it dies."""

from __future__ import annotations

import os
import threading
from collections import deque
from multiprocessing.context import BaseContext

LINES = 12
"""Newest lines that are kept."""
LONGEST = 65_536
"""Bytes of a line without end that are kept."""

PATIENCE = 1.0
"""Wall time for which the end is waited for [s]: what the process started may live on and write, too."""


class StderrTail:
    """The newest lines that another process wrote.

    Args:
        context: Context of the processes.
    """

    def __init__(self, context: BaseContext):
        self._reader, self.writer = context.Pipe(duplex=False)
        self._lines: deque[str] = deque(maxlen=LINES)
        self._thread = threading.Thread(target=self._listen, daemon=True)

    def listen(self) -> None:
        """Begin; the process has its copy of :attr:`writer` by now."""
        self.writer.close()
        self._thread.start()

    def lines(self) -> list[str]:
        """Return the last lines, once the process is dead."""
        self._thread.join(PATIENCE)
        return list(self._lines)

    def _listen(self) -> None:
        rest = b""
        while some := os.read(self._reader.fileno(), 4096):
            *whole, rest = (rest + some).split(b"\n")
            rest = rest[-LONGEST:]
            self._keep(whole)
        self._keep([rest])
        self._reader.close()

    def _keep(self, lines: list[bytes]) -> None:
        self._lines.extend(line.decode(errors="replace").rstrip() for line in lines if line.strip())
