# SPDX-License-Identifier: Apache-2.0
"""Time for which threads of this process wait for a core that others use."""

from __future__ import annotations

import contextlib
from pathlib import Path

BUSY = 0.2
"""Share of the time that threads want to run and wait from which a machine counts as loaded by others."""


class Waiting:
    """Share of the time that this process's threads want to run in which they wait for a core, from now on.

    Linux tells it for each thread; elsewhere it is 0.
    """

    def __init__(self):
        self._before = _thread_times()

    @property
    def share(self) -> float:
        """Share so far, of the threads that live."""
        run = wait = 0
        for thread, (ran, waited) in _thread_times().items():
            earlier = self._before.get(thread, (0, 0))
            run, wait = run + ran - earlier[0], wait + waited - earlier[1]
        return wait / (run + wait) if run + wait > 0 else 0.0


def _thread_times() -> dict[str, tuple[int, int]]:
    """Time for which each thread ran and waited [ns]."""
    times = {}
    for folder in Path("/proc/self/task").glob("*"):
        with contextlib.suppress(OSError, ValueError):
            ran, waited, _ = (folder / "schedstat").read_text().split()
            times[folder.name] = int(ran), int(waited)
    return times
