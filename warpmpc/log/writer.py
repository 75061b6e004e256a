# SPDX-License-Identifier: Apache-2.0
"""The writer of run logs: rows go to disk as they come."""

from __future__ import annotations

import json
import logging
import struct
import threading
import zlib
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .schema import FORMAT, TABLES

logger = logging.getLogger("warpmpc")

CHUNK = struct.Struct("<BII")
"""Head of some rows of a table: its index in the file, number of rows, checksum."""
PERIOD = 0.5
"""Wall time between two writes in the background [s]: as much as a killed run can lose."""


def head(tables: Mapping[str, np.dtype], names: Mapping[str, Any], origin: Mapping[str, Any] | None) -> bytes:
    """First line of a file: its tables with types and units, names of what is in them, where the run comes from."""
    described = {
        table: {name: [kind[name].base.str, list(kind[name].shape), TABLES[table][name].unit] for name in kind.names}
        for table, kind in tables.items()
    }
    about = {"format": FORMAT, "tables": described, "names": dict(names), "origin": origin}
    return json.dumps(about, ensure_ascii=False).encode() + b"\n"


def chunk(index: int, rows: np.ndarray) -> bytes:
    """Rows of the table with an index, ready to be written."""
    data = rows.tobytes()
    return CHUNK.pack(index, rows.size, zlib.crc32(data)) + data


class RunLogWriter:
    """Writes a run log: a line of JSON, then rows of tables in the order in which they come.

    Each row is handed to the operating system before :meth:`add` returns, so that the end of the process takes nothing
    from it. Where that fails (a full disk), an error is logged and the log ends, not the run.

    Args:
        path: The file; what is there is replaced. In memory if None.
        tables: Types of rows by table (:func:`~warpmpc.log.schema.row_type`).
        names: Names of joints, bodies, controls, terms, pairs, errors and clouds.
        origin: Plain data on where the run comes from.
        background: Whether a thread writes, every :data:`PERIOD`, for loops that may not wait for a disk.
    """

    def __init__(
        self,
        path: Path | None,
        tables: Mapping[str, np.dtype],
        *,
        names: Mapping[str, Any],
        origin: Mapping[str, Any] | None = None,
        background: bool = False,
    ):
        self.path, self._tables = path, dict(tables)
        self._index = {table: i for i, table in enumerate(tables)}
        self._pending = deque([head(tables, names, origin)])
        self._file = None
        self._closed, self._writing = threading.Event(), threading.Lock()
        self._thread = threading.Thread(target=self._write_on, daemon=True) if background and path else None
        if path is not None:
            try:
                self._file = open(path, "wb", buffering=0)  # noqa: SIM115
            except OSError as error:
                self._end(error)
            self.flush()
        if self._thread is not None:
            self._thread.start()

    def add(self, table: str, **columns: Any) -> None:
        """Add a row to a table; columns that are left out are zero."""
        row = np.zeros(1, self._tables[table])
        for name, value in columns.items():
            row[name] = value
        self.add_rows(table, row)

    def add_rows(self, table: str, rows: np.ndarray) -> None:
        """Add rows ``[n]`` of the table's type."""
        self._pending.append(chunk(self._index[table], rows))
        if self._thread is None and self.path is not None:
            self.flush()

    def flush(self) -> None:
        """Write what waits."""
        with self._writing:
            data = b"".join(self._pending.popleft() for _ in range(len(self._pending)))
            if self._file is None:
                return
            try:
                written = self._file.write(data)
                if written != len(data):
                    raise OSError(f"{written} of {len(data)} bytes were written")
            except OSError as error:
                self._end(error)

    def content(self) -> bytes:
        """The log so far, as a file has it.

        Raises:
            OSError: If the file cannot be read.
        """
        if self.path is None:
            return b"".join(self._pending)
        self.flush()
        return self.path.read_bytes()

    def close(self) -> None:
        """Write what is left and close the file; closing twice does no harm."""
        if self._thread is not None:
            self._closed.set()
            self._thread.join()
            self._thread = None
        if self._file is not None:
            self.flush()
        if self._file is not None:
            self._file.close()
            self._file = None

    def _end(self, error: OSError) -> None:
        logger.error("the run log '%s' ends here: %s", self.path, error.strerror or error)
        if self._file is not None:
            self._file.close()
        self._file = None

    def _write_on(self) -> None:
        while not self._closed.wait(PERIOD):
            self.flush()
