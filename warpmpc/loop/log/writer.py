# SPDX-License-Identifier: Apache-2.0
"""The writer of run logs: rows go to disk as they come.

Tables and columns of a run log.
"""

from __future__ import annotations

import json
import logging
import struct
import threading
import zlib
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...physics.runtime.files import Unwritable, writing

FORMAT = "warpmpc run log 1"


class Column(NamedTuple):
    """One column of a table."""

    text: str
    unit: str = ""
    shape: tuple[str | int, ...] = ()
    """Axes of a row: numbers, or names of sizes."""
    dtype: str = "f8"


Q, QD = "m, rad", "m/s, rad/s"
U = "units of the drives"
"""Unit of controls."""

TABLES: dict[str, dict[str, Column]] = {
    # true states of the plant: one before each control, one at the end
    "states": {
        "time": Column("simulated time", "s"),
        "joint_q": Column("joint coordinates", Q, ("nq",)),
        "joint_qd": Column("joint velocities", QD, ("nv",)),
        "body_q": Column("poses of bodies in the world (x, y, z, qx, qy, qz, qw)", "m", ("nb", 7)),
        "contact_force": Column(
            "net force on the first of a pair at the last physics step, NaN at the start", "N", ("pairs", 3)
        ),
        "goal_error": Column("distances to the goal", Q, ("errors",)),
    },
    # what was sent: a control, or a tick in real time
    "controls": {
        "control": Column("control applied, NaN where none was sent", U, ("nu",)),
        "plan": Column("number of the newest plan, -1 before the first", dtype="i8"),
        "plan_ms": Column("wall time of that plan", "ms"),
        "following": Column("whether the control came from that plan, not from the watchdog", dtype="?"),
        "late_ms": Column("lateness of the tick in wall time", "ms"),
        "age": Column("time since the observation that the plan was made from, NaN without a plan", "s"),
        "clock": Column("clock of the robot", "s"),
        "seen_time": Column("time of the observation", "s"),
        "seen_q": Column("observed joint coordinates, NaN where their count was wrong", Q, ("nq",), "f4"),
        "seen_qd": Column("observed joint velocities", QD, ("nv",), "f4"),
        "seen_act": Column("observed activations", "", ("na",), "f4"),
        "seen_mocap": Column("observed poses of mocap bodies", "m", ("nm", 7), "f4"),
    },
    # what plans were made from and what they came to
    "plans": {
        "number": Column("number of the plan; one that its planner did not hand over has that of the next", dtype="i8"),
        "time": Column("time of the observation", "s"),
        "joint_q": Column("observed joint coordinates", Q, ("nq",), "f4"),
        "joint_qd": Column("observed joint velocities", QD, ("nv",), "f4"),
        "act": Column("observed activations, NaN where they were left out", "", ("na",), "f4"),
        "mocap": Column("observed poses of mocap bodies, NaN where they were left out", "m", ("nm", 7), "f4"),
        "task": Column("poses, scalars and weights: a row of Task.block", "", ("task",), "f4"),
        "lower": Column("lower limits of the controls", U, ("nu",), "f4"),
        "upper": Column("upper limits of the controls", U, ("nu",), "f4"),
        "cost": Column("cost of the best sample"),
        "terms": Column("share of each term in it, weighted and discounted", "", ("terms",)),
        "beta": Column("temperature β that weighed the samples next time"),
        "eta": Column("effective number of samples η"),
        "proposer": Column("where the plan comes from, its number among PROPOSERS of Info", dtype="i1"),
        "lowered": Column("share by which derivatives lowered its predicted cost"),
        "command": Column("command that the controller returned", U, ("nu",), "f4"),
        "knot_time": Column("times of the knots", "s", ("knots",)),
        "knots": Column("the plan", U, ("knots", "nu"), "f4"),
        # in real time
        "life": Column("planner process that made it, from 0", dtype="i8"),
        "sent": Column("control that the robot was sent last", U, ("nu",), "f4"),
        "following": Column("whether that came from a plan", dtype="?"),
        "reach": Column("time by which the observation was predicted forward", "s"),
        "latency": Column("time from the observation to the plan", "s"),
        "plan_ms": Column("wall time of the planning", "ms"),
        "survived": Column("whether a rollout survived", dtype="?"),
    },
    # changes of the watchdog's faults: the last row of an index holds
    "faults": {
        "index": Column("number of the fault", dtype="i8"),
        "kind": Column("kind of the fault", dtype="U64"),
        "why": Column("a sentence about it", dtype="U240"),
        "start": Column("begin on the clock of the robot", "s"),
        "end": Column("end, NaN while it lasts", "s"),
        "count": Column("times it came and went", dtype="i8"),
    },
    # points of clouds, at the first plan that saw them
    "clouds": {
        "cloud": Column("index of the cloud among its names", dtype="i8"),
        "plan": Column("row of the plan", dtype="i8"),
        "begins": Column("whether a new set of points follows; this row holds none", dtype="?"),
        "point": Column("a point", "m", (3,), "f4"),
    },
}
"""Columns by table."""

ORIGIN: dict[str, tuple[type, ...]] = {
    **dict.fromkeys(("scene", "text", "engine", "device", "strategy", "code"), (str,)),
    **dict.fromkeys(("variant", "file", "revision"), (str, type(None))),
    **dict.fromkeys(("seed", "samples"), (int,)),
    **dict.fromkeys(("versions", "hardware"), (dict,)),
}
"""What is known of where a controller's plans come from, with its types."""
POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
FORCE = ("x", "y", "z")


def row_type(table: str, sizes: Mapping[str, int], columns: Sequence[str] | None = None) -> np.dtype:
    """Type of a row of a table.

    Args:
        sizes: Sizes of the axes by name.
        columns: Columns that are kept, all of them if None.
    """
    kept = [(name, TABLES[table][name]) for name in columns or TABLES[table]]
    return np.dtype([(name, c.dtype, tuple(sizes.get(axis, axis) for axis in c.shape)) for name, c in kept])


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
    from it. Where that fails (a full disk), an error is logged and the file ends, not the run; memory has the rest.

    Args:
        path: The file; what is there is replaced. In memory if None.
        tables: Types of rows by table (:func:`~warpmpc.loop.log.writer.row_type`).
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
        self._file, self._whole = None, 0
        self._closed, self._writing = threading.Event(), threading.Lock()
        self._thread = threading.Thread(target=self._write_on, daemon=True) if background and path else None
        if path is not None:
            try:
                with writing(path):
                    self._file = open(path, "wb", buffering=0)  # noqa: SIM115
            except Unwritable as error:
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
            if self._file is None:
                return
            data = b"".join(self._pending.popleft() for _ in range(len(self._pending)))
            try:
                with writing(self.path):
                    written = 0
                    while written < len(data):  # a disk that is nearly full takes a part
                        written += self._file.write(data[written:])
                self._whole += len(data)
            except Unwritable as error:
                self._pending.appendleft(data)
                self._end(error)

    def content(self) -> bytes:
        """The log so far, as a file has it, or would have it.

        Raises:
            OSError: If the file cannot be read.
        """
        self.flush()
        kept = self.path.read_bytes()[: self._whole] if self._whole else b""
        return kept + b"".join(self._pending)

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

    def _end(self, error: Unwritable) -> None:
        logger.error("%s; the log ends here", error)
        if self._file is not None:
            self._file.close()
        self._file = None

    def _write_on(self) -> None:
        while not self._closed.wait(PERIOD):
            self.flush()
