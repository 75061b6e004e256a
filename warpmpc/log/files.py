# SPDX-License-Identifier: Apache-2.0
"""Files that are written whole or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any


@contextmanager
def replacing(path: Path, mode: str = "w", **keys: Any) -> Iterator[IO]:
    """Open a file beside another, whose place it takes once it is whole; what was there stays until then.

    Args:
        path: The file that is replaced; where a symbolic link leads.
        mode: ``w`` or ``wb``.

    Raises:
        OSError: If it cannot be written; the old file is as it was.
    """
    target = path.resolve()
    part = target.with_name(f".{target.name}.{os.getpid()}")
    try:
        with open(part, mode, **keys) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        if target.exists():
            part.chmod(target.stat().st_mode)
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)


def try_file(path: Path) -> None:
    """Refuse a file that could not be written; nothing is changed.

    Raises:
        OSError: If it could not.
    """
    target = path.resolve()
    if target.exists() and not target.is_file():
        raise OSError(f"cannot write '{path}': there is something that is no file; give another name")
    if target.exists() and not os.access(target, os.W_OK):
        raise OSError(f"cannot write '{path}': it is read-only; give another name")
    try:
        tempfile.TemporaryFile(dir=target.parent).close()
    except OSError as error:
        raise OSError(f"cannot write '{path}': {error.strerror}; give a file in another folder") from None
