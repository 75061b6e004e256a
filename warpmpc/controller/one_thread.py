# SPDX-License-Identifier: Apache-2.0
"""Methods of what one thread at a time may use."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TypeVar

Method = TypeVar("Method", bound=Callable)


def one_thread(method: Method) -> Method:
    """Refuse a call of a method while another thread is in a method of the same object's; nobody waits.

    The object has a ``threading.RLock`` in ``_in_use``.
    """

    @functools.wraps(method)
    def guarded(self: object, *args: object, **options: object) -> object:
        if not self._in_use.acquire(blocking=False):
            raise RuntimeError(
                f"another thread uses this {type(self).__name__} now: give each thread one of its own, "
                "or let one thread call it"
            )
        try:
            return method(self, *args, **options)
        finally:
            self._in_use.release()

    return guarded
