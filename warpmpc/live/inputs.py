# SPDX-License-Identifier: Apache-2.0
"""Changes that browsers make to inputs of the page."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


def on_change(made: Any, change: Callable[[Any], None]) -> None:
    """Call a function with the new value when a browser changes an input, but not when the page shows one anew.

    A browser may send anything: a value that is not in a dropdown's list is put back.

    Args:
        made: Handle of the input.
        change: Takes the value.
    """
    listed, held = tuple(getattr(made, "options", ())), made.value

    def changed(event: Any) -> None:
        nonlocal held
        value = made.value  # read once: another message may come
        if listed and value not in listed:
            made.value = held
            return
        held = value
        if event.client is not None:
            change(value)

    made.on_update(changed)
