# SPDX-License-Identifier: Apache-2.0
"""Ends what a user's function does not end by itself."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


class TooLong(TimeoutError):
    """A user's function took longer than it may; raised in the line it was at."""

    def __str__(self) -> str:
        return "this takes too long: does a loop not end?"


@contextmanager
def deadline(seconds: float) -> Iterator[None]:
    """Raise :class:`TooLong` in this thread's Python code if it is not through after a time.

    Args:
        seconds: How long it may take [s]. A call into native code is waited for.
    """
    this, lock, through = threading.get_ident(), threading.Lock(), threading.Event()

    def end() -> None:
        with lock:
            if not through.is_set():
                ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(this), ctypes.py_object(TooLong))

    timer = threading.Timer(seconds, end)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        with lock:  # from here on nothing is raised any more
            through.set()
        timer.cancel()


def leave_after(seconds: float, call: Callable[[], Any]) -> None:
    """Make a call into native code and wait for it, but no longer than a time.

    Args:
        seconds: How long it may take [s].
        call: The call; what it raises is raised here. One that takes longer goes on in a thread that nobody waits for.

    Raises:
        TooLong: If it is not through by then.
    """
    raised: list[BaseException] = []

    def make() -> None:
        try:
            call()
        except BaseException as error:
            raised.append(error)

    thread = threading.Thread(target=make, daemon=True)
    thread.start()
    thread.join(seconds)
    if thread.is_alive():
        raise TooLong
    if raised:
        raise raised[0]
