# SPDX-License-Identifier: Apache-2.0
"""A file of finished jobs, so that none is run twice."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, BinaryIO


class Records:
    """Finished jobs, one JSON object a line, in the order they ended.

    Args:
        path: The file; made when the first record is added.

    Raises:
        OSError: If the file cannot be read.
        ValueError: If it holds something else.
    """

    def __init__(self, path: Path):
        self.path = path
        self.by_key: dict[str, dict[str, Any]] = {}
        """Key of the job → record."""
        for number, line in enumerate(path.read_bytes().splitlines(keepends=True) if path.exists() else ()):
            if not line.endswith(b"\n"):
                break  # cut off in the middle of writing
            try:
                record = json.loads(line)
                self.by_key[record["key"]] = record
            except (ValueError, TypeError, KeyError):
                raise ValueError(f"{path}:{number + 1}: is no record of a finished run; take another file") from None

    def add(self, key: str, record: dict[str, Any]) -> None:
        """Keep a finished job, on disk before this returns."""
        record = {"key": key, **record}
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with open(self.path, "ab+") as file:
            if file.tell() > 0:
                file.seek(-1, os.SEEK_END)
                if file.read() != b"\n":
                    self._repair(file)
            file.write(json.dumps(record, ensure_ascii=False).encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())
        self.by_key[key] = record

    @staticmethod
    def _repair(file: BinaryIO) -> None:
        """Drop a last line that was cut off."""
        file.seek(0)
        file.truncate(file.read().rfind(b"\n") + 1)
