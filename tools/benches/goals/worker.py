# SPDX-License-Identifier: Apache-2.0
"""A process that measures row after row, and is ended and started anew when one crashes or takes too long."""

from __future__ import annotations

import logging
import multiprocessing
import os
import time

from .rows import Row

_CONTEXT = multiprocessing.get_context("spawn")


class Worker:
    """Measures rows in a separate process, another for each number of cores: threads keep to those of their start."""

    def __init__(self):
        self._process, self._pipe, self._cores = None, None, None
        self._all = os.sched_getaffinity(0)

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *error: object) -> None:
        self._end()

    def call(self, row: Row, settings: dict, seconds: float) -> dict:
        """What a row gave; what it told before it failed or ran out of time, with the ``error``.

        Args:
            row: The row.
            settings: Keyword arguments of :func:`goals.measure.measure`.
            seconds: Time it has, starting a process included.
        """
        end = time.perf_counter() + seconds
        if self._process is None or self._cores != row.cores:
            self._end()
            self._start(row.cores)
        self._pipe.send((row, settings, seconds))
        found: dict = {}
        while True:
            if not self._pipe.poll(max(0.0, end - time.perf_counter())):
                self._end()
                return found | {"error": f"took longer than {seconds:.0f} s"}
            try:
                done, part = self._pipe.recv()
            except EOFError:
                code = self._process.exitcode
                self._end()
                return found | {"error": f"the process died ({code})"}
            found |= part
            if done:
                if "crash" in found:  # after an error of a GPU nothing works in its process any more
                    self._end()
                    found["error"] = found.pop("crash")
                return found

    def _start(self, cores: int | None) -> None:
        self._cores = cores
        self._pipe, theirs = _CONTEXT.Pipe()
        allowed = sorted(self._all) if cores is None else sorted(self._all)[:cores]
        self._process = _CONTEXT.Process(target=_serve, args=(theirs, allowed), daemon=True)
        self._process.start()
        theirs.close()

    def _end(self) -> None:
        if self._process is not None:
            self._pipe.close()
            self._process.kill()
            self._process.join()
            self._process = None


def _serve(pipe: multiprocessing.connection.Connection, allowed: list[int]) -> None:
    """Measure what comes in until the other end is closed."""
    os.sched_setaffinity(0, allowed)
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)  # libraries chat on standard output, from native code, too
    logging.getLogger("warpmpc").setLevel(logging.ERROR)
    from warpmpc.cli.setup import start_warp

    start_warp()
    from .measure import measure

    while True:
        try:
            row, settings, seconds = pipe.recv()
        except EOFError:
            return
        try:
            for part in measure(row, seconds=seconds, **settings):
                pipe.send((False, part))
            pipe.send((True, {}))
        except Exception as error:  # one row that fails must not end the others
            pipe.send((True, {"crash": f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"}))
