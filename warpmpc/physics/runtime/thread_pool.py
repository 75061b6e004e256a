# SPDX-License-Identifier: Apache-2.0
"""A pool of threads that share the worlds of a batch between them."""

from __future__ import annotations

import ctypes
import os
import threading
import time
import weakref
from collections.abc import Sequence

import numpy as np
import warp as wp

from ...kernels.engine.thread_pool import BOARD, take_parts_kernel
from .launch import CapturedLaunches, capturing, replay_address

PARTS = 4
"""Parts of the worlds per thread: worlds with much contact take longer, and equal shares would leave threads idle."""
_AT = {name: place for place, name in enumerate(BOARD)}


def thread_count(wanted: int) -> int:
    """Number of threads for a wish, where 0 is one per core that this process may use."""
    return wanted or len(os.sched_getaffinity(0))


class ThreadPool:
    """Replays sequences of launches on several threads, the calling one among them.

    Each thread takes the next sequence that is left, so that worlds with much contact do not hold up the rest. The
    threads wait, wake and work in native code: with Python's lock to be handed round, sixteen of them took a
    millisecond to start.

    Args:
        threads: Number of threads.
        parts: Most sequences that are run at once.
    """

    thread: np.ndarray
    """Thread that took each part last ``[parts]``."""

    def __init__(self, threads: int, parts: int):
        self.threads, self.parts = min(threads, parts), parts
        self.thread = np.zeros(parts, dtype=np.int32)
        self._graphs = np.zeros(parts, dtype=np.uint64)
        self._known: Sequence[CapturedLaunches] | None = None
        self._board: np.ndarray | None = None
        if self.threads > 1:
            self._start()

    def _start(self) -> None:
        """Start the helpers and wait until they are ready."""
        self._process, self._known = os.getpid(), None
        python = ctypes.pythonapi
        python.PyThread_allocate_lock.restype = ctypes.c_void_p
        locks = [python.PyThread_allocate_lock() for _ in range(self.threads + 1)]
        self._locks = np.array(locks, dtype=np.uint64)
        board = self._board = np.zeros(len(BOARD), dtype=np.uint64)

        def address(function: object) -> int:
            return ctypes.cast(function, ctypes.c_void_p).value

        board[_AT["ACQUIRE"]] = address(python.PyThread_acquire_lock)
        board[_AT["RELEASE"]] = address(python.PyThread_release_lock)
        board[_AT["REPLAY"]] = replay_address()
        board[_AT["GO"]], board[_AT["DONE"]] = self._locks.ctypes.data, locks[-1]
        board[_AT["GRAPHS"]], board[_AT["THREAD"]] = self._graphs.ctypes.data, self.thread.ctypes.data
        board[_AT["PARTS"]], board[_AT["WOKEN"]] = self.parts, self.threads - 1
        python.PyThread_acquire_lock.argtypes = [ctypes.c_void_p, ctypes.c_int]
        for lock in locks:  # they are waited at before any is released
            python.PyThread_acquire_lock(lock, 1)
        with capturing:
            wp.load_module(take_parts_kernel.module, device="cpu")
            for helper in range(1, self.threads):
                threading.Thread(
                    target=_help, args=[board, self._locks, self._graphs, self.thread, helper], daemon=True
                ).start()
            while board[_AT["READY"]] < self.threads - 1:
                time.sleep(1e-4)
            self._lead = wp.launch(
                take_parts_kernel, dim=1, inputs=[board.ctypes.data, 0], device="cpu", record_cmd=True
            )
        self._end = weakref.finalize(self, _end, board, locks[1:-1])

    def run(self, replays: Sequence[CapturedLaunches]) -> None:
        """Run sequences, each on whatever thread takes it; returns when all are done.

        Args:
            replays: One for each part, or fewer; hand over the same list every time.

        Raises:
            RuntimeError: If one of them could not be replayed.
        """
        if self.threads > 1 and self._process != os.getpid():  # a fork does not have them
            self._end.detach()
            self._start()
        if replays is not self._known and not self._hand_over(replays):
            return
        if self.threads == 1:
            for replay in replays:
                replay()
            return
        board = self._board
        self._lead.launch()
        if board[_AT["FAILED"]]:
            board[_AT["FAILED"]] = 0
            raise RuntimeError("a recorded sequence of launches could not be replayed")

    def _hand_over(self, replays: Sequence[CapturedLaunches]) -> bool:
        """Hand sequences to the helpers; returns False where that took running them, one after the other."""
        self.thread[:] = 0
        recorded = [replay.record() for replay in replays]
        if not all(recorded):
            return False
        self._graphs[: len(replays)] = [replay.address for replay in replays]
        if self.threads > 1:
            self._board[_AT["PARTS"]] = len(replays)
        self._known = replays
        return True

    def close(self) -> None:
        """End the threads."""
        if self.threads > 1:
            self._end()


def _help(board: np.ndarray, locks: np.ndarray, graphs: np.ndarray, thread: np.ndarray, helper: int) -> None:
    """Work of a helper, in native code; the arrays are kept alive for it."""
    wp.launch(take_parts_kernel, dim=1, inputs=[board.ctypes.data, helper], device="cpu")


def _end(board: np.ndarray, go: Sequence[int]) -> None:
    board[_AT["QUIT"]] = 1
    for lock in go:
        ctypes.pythonapi.PyThread_release_lock(ctypes.c_void_p(lock))
