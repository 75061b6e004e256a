# SPDX-License-Identifier: Apache-2.0
"""The reader of run logs, and what is made of them: columns, CSV and NPZ files."""

from __future__ import annotations

import csv
import glob
import json
import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...physics.runtime.files import plain, read_npz, replacing, require_regular
from ...scene.model.state import State
from .writer import CHUNK, FORCE, FORMAT, ORIGIN, POSE, TABLES, chunk, head

SUFFIX = ".runlog"
"""Suffix of a log as it is written."""
FILES = (".csv", ".npz", SUFFIX)
FLAT = ("states", "controls")
"""Tables whose columns have no ``TABLE/`` before their names in NPZ files."""


@dataclass(frozen=True, kw_only=True)
class RunLog:
    """A run of one plant and one controller as tables, each a record array: ``log.states.joint_q`` is ``[N+1, nq]``.

    Row n of the N ``controls`` was sent in state n and led to state n + 1 of the N + 1 ``states``, which are true ones.
    In closed loop a row is one planned control, in real time one tick. ``plans`` holds what plans were made from and
    what they came to. Quaternions are x, y, z, w; free-joint twists are of the centre of mass. Columns, shapes and
    units are those of ``warpmpc.loop.log.writer.TABLES``; a log has those that its kind of run knows.
    """

    states: np.recarray
    controls: np.recarray
    plans: np.recarray
    faults: np.recarray
    """Changes of the watchdog's faults."""
    clouds: np.recarray
    names: dict[str, list[str]]
    """Names of what columns hold, by ``joint_q``, ``joint_qd``, ``bodies``, ``controls``, ``pairs``, ``errors``,
    ``terms`` and ``clouds``."""
    origin: dict[str, Any] | None
    """Plain data: scene as text, seed, engine, device, strategy, versions, source, hardware; None where unknown."""

    @property
    def real_time(self) -> bool:
        """Return whether rows of ``controls`` are ticks of a run in real time."""
        return "clock" in (self.controls.dtype.names or ())

    @property
    def title(self) -> str:
        """Scene, variant and seed in words; empty where they are unknown."""
        if self.origin is None:
            return ""
        name = ":".join(filter(None, (self.origin["scene"], self.origin["variant"])))
        return plain(f"{name}, seed {self.origin['seed']}")

    def plan_rows(self) -> np.ndarray:
        """Row in ``plans`` of the newest plan at each control ``[N]``; -1 where it is not there."""
        if not len(self.plans):
            return np.full(len(self.controls), -1)
        rows = {int(n): row for row, n in enumerate(self.plans.number)}  # of equal numbers the last was handed over
        return np.array([rows.get(int(n), -1) for n in self.controls.plan], dtype=int)

    def of_plans(self, column: str) -> np.ndarray:
        """A column of the newest plan at each control ``[N, ...]``, NaN where it is unknown."""
        if not len(self.plans):
            return np.full((len(self.controls), *[len(self.names["terms"])] * (column == "terms")), np.nan)
        values, rows = self.plans[column], self.plan_rows()
        return np.where((rows >= 0).reshape(-1, *[1] * (values.ndim - 1)), values[rows], np.nan)

    def observed(self, plan: int) -> State:
        """The observation that a row of ``plans`` was made from."""
        row = self.plans[plan]
        return State(row.joint_q, row.joint_qd, time=float(row.time), act=row.act, mocap=row.mocap)

    def seen(self, tick: int) -> State:
        """The observation of a tick in real time."""
        row = self.controls[tick]
        return State(row.seen_q, row.seen_qd, time=float(row.seen_time), act=row.seen_act, mocap=row.seen_mocap)

    def points(self) -> dict[str, dict[int, np.ndarray]]:
        """Points ``[n, 3]`` of each cloud by the row of the plan that was the first to see them."""
        found: dict[str, dict[int, np.ndarray]] = {name: {} for name in self.names.get("clouds", ())}
        if len(self.clouds):
            begins = np.flatnonzero(self.clouds.begins)
            for rows in np.split(self.clouds, begins[1:]):
                found[self.names["clouds"][rows.cloud[0]]][int(rows.plan[0])] = rows.point[1:]
        return found

    def columns(self) -> dict[str, np.ndarray]:
        """Numbers ``[N+1]`` by name, a row for each state; what belongs to controls is NaN in the last.

        Names are ``time``, ``joint_q/NAME``, ``joint_qd/NAME``, ``body_q/NAME/x`` to ``/qw``,
        ``contact_force/NAME/x`` to ``/z``, ``control/NAME``, ``cost``, ``cost/NAME`` of each term, ``plan_ms``,
        ``beta``, ``eta``, ``proposer``, ``lowered``, ``goal_error/NAME``.
        """
        states, controls, names = self.states, self.controls, self.names
        parts: list[tuple[list[str], np.ndarray]] = [
            (["time"], states.time),
            ([f"joint_q/{name}" for name in names["joint_q"]], states.joint_q),
            ([f"joint_qd/{name}" for name in names["joint_qd"]], states.joint_qd),
            ([f"body_q/{name}/{axis}" for name in names["bodies"] for axis in POSE], states.body_q),
            ([f"contact_force/{name}/{axis}" for name in names["pairs"] for axis in FORCE], states.contact_force),
            ([f"control/{name}" for name in names["controls"]], controls.control),
            (["cost"], self.of_plans("cost")),
            ([f"cost/{name}" for name in names["terms"]], self.of_plans("terms")),
            (["plan_ms"], controls.plan_ms),
            *(([name], self.of_plans(name)) for name in ("beta", "eta", "proposer", "lowered")),
            ([f"goal_error/{name}" for name in names["errors"]], states.goal_error),
        ]
        rows, found = len(states), {}
        for labels, table in parts:
            for name, column in zip(labels, table.reshape(len(table), math.prod(table.shape[1:])).T, strict=True):
                found[name] = np.concatenate([column, np.full(rows - len(table), np.nan)])
        return found

    def save(self, path: str | Path) -> None:
        """Write a file.

        A ``.csv`` file has the :meth:`columns`, with empty cells for NaN, an ``.npz`` file an array for each column of
        each table, a ``.runlog`` file is as a run writes it. A file that is there is replaced when the new one is
        whole, and stays as it is where that fails.

        Raises:
            ValueError: If the file's name ends otherwise.
            OSError: If it cannot be written.
        """
        path = log_file(path)
        tables = {name: getattr(self, name) for name in TABLES}
        if path.suffix == ".csv":
            self._save_csv(path)
        elif path.suffix == ".npz":
            arrays = {_npz_name(table, c): rows[c] for table, rows in tables.items() for c in rows.dtype.names or ()}
            about = json.dumps({"format": FORMAT, "names": self.names, "origin": self.origin}, ensure_ascii=False)
            with replacing(path, "wb") as file:
                np.savez_compressed(file, about=np.array(about), **arrays)
        else:
            kept = {name: rows for name, rows in tables.items() if rows.dtype.names}
            with replacing(path, "wb") as file:
                file.write(head({name: rows.dtype for name, rows in kept.items()}, self.names, self.origin))
                file.writelines(chunk(i, rows) for i, rows in enumerate(kept.values()))

    def _save_csv(self, path: Path) -> None:
        columns = self.columns()
        with replacing(path, encoding="utf-8", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(columns)
            for row in zip(*(column.tolist() for column in columns.values()), strict=True):
                writer.writerow(["" if value != value else f"{value:.9g}" for value in row])

    @classmethod
    def load(cls, path: str | Path) -> RunLog:
        """Read a ``.runlog`` file, with those of planners in real time beside it, or an ``.npz`` file.

        Of a run that was killed the whole rows are read.

        Raises:
            ValueError: If it is something else, or damaged.
            OSError: If it cannot be read.
        """
        path = Path(path)
        try:
            require_regular(path)
            with open(path, "rb") as file:
                packed = file.read(2) == b"PK"
            if packed:
                with read_npz(path) as data:
                    return cls._from_arrays(data)
            log = cls.parse(path.read_bytes())
            found = read_planners(path)
            if found is None:
                return log
            return replace(log, plans=found.plans, names={**log.names, **found.names}, origin=found.origin)
        except (ValueError, KeyError, TypeError, AttributeError, IndexError) as error:
            raise ValueError(f"{path}: is no run log: {error}") from None

    @classmethod
    def parse(cls, content: bytes) -> RunLog:
        """Read what a :class:`~warpmpc.loop.log.writer.RunLogWriter` wrote.

        Raises:
            ValueError: If it is something else, or damaged.
        """
        line, _, rest = content.partition(b"\n")
        about = json.loads(line)
        if about["format"] != FORMAT:
            raise ValueError(f"it is of the format '{about['format']}', not '{FORMAT}'")
        kinds = [
            np.dtype([(name, kind, tuple(shape)) for name, (kind, shape, _) in columns.items()])
            for columns in about["tables"].values()
        ]
        parts: list[list[np.ndarray]] = [[np.zeros(0, kind)] for kind in kinds]
        at = 0
        while at + CHUNK.size <= len(rest):
            index, count, checksum = CHUNK.unpack_from(rest, at)
            at += CHUNK.size
            end = at + count * kinds[index].itemsize
            if end > len(rest):
                break  # the run was killed while it wrote
            rows = np.frombuffer(rest, kinds[index], count, at)
            if zlib.crc32(rest[at:end]) != checksum:
                raise ValueError(f"it is damaged at byte {len(line) + 1 + at}")
            parts[index].append(rows)
            at = end
        tables = {name: np.concatenate(rows) for name, rows in zip(about["tables"], parts, strict=True)}
        return cls._of(tables, about)

    @classmethod
    def _of(cls, tables: Mapping[str, np.ndarray], about: Mapping[str, Any]) -> RunLog:
        """A log of tables; the last row of one may have come without that of the other."""
        found = {name: np.asarray(tables.get(name, np.zeros(0, []))).view(np.recarray) for name in TABLES}
        whole = min(len(found["controls"]), max(len(found["states"]) - 1, 0))
        found["states"], found["controls"] = found["states"][: whole + 1], found["controls"][:whole]
        origin = about["origin"]
        for key, kinds in ORIGIN.items() if origin is not None else ():
            if not isinstance(origin[key], kinds):
                raise ValueError(f"its origin has {key} = {str(origin[key])[:40]}")
        return cls(**found, names=dict(about["names"]), origin=origin)

    @classmethod
    def _from_arrays(cls, data: Mapping[str, np.ndarray]) -> RunLog:
        names = {table: [c for c in columns if _npz_name(table, c) in data] for table, columns in TABLES.items()}
        tables = {
            table: _table({c: data[_npz_name(table, c)] for c in names[table]}) for table in TABLES if names[table]
        }
        about = json.loads(str(data["about"]))
        if about["format"] != FORMAT or not {"states", "controls"} <= tables.keys():
            raise ValueError("it lacks what a run has")
        return cls._of(tables, about)


def _npz_name(table: str, column: str) -> str:
    return column if table in FLAT else f"{table}/{column}"


def _table(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Rows of columns of one length.

    Raises:
        ValueError: If their lengths differ.
    """
    if len({len(column) for column in columns.values()}) > 1:
        raise ValueError(f"lengths of {', '.join(columns)} differ")
    kinds = [(name, column.dtype.str, column.shape[1:]) for name, column in columns.items()]
    rows = np.zeros(len(next(iter(columns.values()))), kinds)
    for name, column in columns.items():
        rows[name] = column
    return rows


def log_file(path: str | Path) -> Path:
    """The path of a file for a run log.

    Raises:
        ValueError: If its name does not end in ``.csv``, ``.npz`` or ``.runlog``.
    """
    path = Path(path)
    if path.suffix not in FILES:
        raise ValueError(f"a run log is a {', '.join(FILES[:-1])} or {FILES[-1]} file, not '{path}'")
    return path


def planner_files(path: Path) -> list[Path]:
    """Files beside a run log in which planners of a run in real time noted their plans, in their order."""
    return sorted(
        (file for file in path.parent.glob(f"{glob.escape(path.name)}.*") if file.suffix[1:].isdecimal()),
        key=lambda file: int(file.suffix[1:]),
    )


def read_planners(path: Path) -> RunLog | None:
    """Read the plans that planners beside a run log noted; None where there are none.

    Raises:
        OSError: If a file cannot be read.
        ValueError: If one is damaged.
    """
    contents = [file.read_bytes() for file in planner_files(path) if file.is_file()]
    logs = [RunLog.parse(content) for content in contents if b"\n" in content]  # else killed before the first plan
    plans = [log.plans for log in logs]
    return replace(logs[-1], plans=np.concatenate(plans).view(np.recarray)) if logs else None
