# SPDX-License-Identifier: Apache-2.0
"""The one error a user sees when a scene is wrong."""

from __future__ import annotations

import difflib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path


class SceneError(ValueError):
    """A mistake in a scene: which file, which key, what was found, what is allowed and how to mend it.

    Args:
        message: What is wrong, in one sentence.
        key: Dotted key of the scene (``robot.base.drive.limit``).
        file: Scene file, when the scene came from one.
        found: The offending value.
        allowed: What may stand there instead, as a phrase or as the list of allowed names. With a list, the
            nearest name to ``found`` is suggested.
    """

    def __init__(
        self,
        message: str,
        *,
        key: str | None = None,
        file: Path | str | None = None,
        found: object = None,
        allowed: str | Iterable[str] | None = None,
    ):
        self.message, self.key, self.file, self.found = message, key, file, found
        self.allowed = allowed if isinstance(allowed, str) or allowed is None else sorted(map(str, allowed))
        super().__init__(str(self))

    @property
    def suggestion(self) -> str | None:
        """The allowed name nearest to what was found, if any is near."""
        if isinstance(self.allowed, list) and isinstance(self.found, str):
            near = difflib.get_close_matches(self.found, self.allowed, n=1, cutoff=0.5)
            return near[0] if near else None
        return None

    def __str__(self) -> str:
        where = ": ".join(str(part) for part in (self.file, self.key) if part is not None)
        text = f"{where}: {self.message}" if where else self.message
        if self.found is not None:
            text += f"; found {self.found!r}"
        if isinstance(self.allowed, str):
            text += f"; allowed: {self.allowed}"
        elif self.allowed is not None:
            text += f"; allowed: {', '.join(self.allowed) if self.allowed else 'nothing, there is none'}"
        if self.suggestion:
            text += f". Did you mean {self.suggestion!r}?"
        return text
