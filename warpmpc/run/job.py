# SPDX-License-Identifier: Apache-2.0
"""Calls made beside this process: where they may run, and how they are lost."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, Protocol

TRIES = 3
"""Attempts at a call whose process dies each time."""
GPUS = "gpus"
RAY = "ray"
FORMS = f"a number of processes, {GPUS}, {RAY} or {RAY}:HOST:PORT"
"""Values of ``--jobs``."""

Prepare = Callable[[], None]
"""Called once in every process, before its first call; a function at the top of a module."""


class LostJob(RuntimeError):
    """A call whose process died as often as it was made."""

    def __init__(self):
        super().__init__(f"a process died {TRIES} times in the same job, out of memory perhaps")


class Workers(Protocol):
    """Workers that make calls beside this process; leaving the context ends them, whatever they are at."""

    count: int
    """Calls that are made at a time."""

    def __enter__(self) -> Workers:
        """Take the workers for a while."""

    def __exit__(self, *error: object) -> None:
        """End them."""

    def submit(self, function: Callable[..., Any], *arguments: object) -> Future[Any]:
        """Queue a call of a module's function; the future holds what it returns or raises, or :class:`LostJob`."""
