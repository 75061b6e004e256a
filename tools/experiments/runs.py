# SPDX-License-Identifier: Apache-2.0
"""The runs of a table: which there are to make, which are made already, and the file they are kept in."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import shlex
from collections.abc import Callable, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from scene_keys import spread
from workers import OMPL, PLANNER, Job, Workers

import warpmpc

from .tables import Cell


@dataclass(frozen=True, kw_only=True)
class Run:
    """One run of one cell."""

    table: str
    cell: str
    job: Job
    scene_hash: str
    """Hash of the scene's validated content."""

    @property
    def key(self) -> str:
        """What tells it from other runs; runs of one key are never repeated."""
        job = self.job
        parts = (self.table, self.cell, job.scene, job.overrides, job.seed, job.engine, job.device, self.scene_hash)
        return json.dumps(parts)

    @property
    def command(self) -> str:
        """The command that makes this run alone."""
        job = self.job
        words = ["python", "tools/baselines.py"] if job.method == OMPL else ["warpmpc", "run"]
        words += [job.scene, "--seed", str(job.seed)]
        if job.method == PLANNER:
            words += [f"--{name}={value}" for name in ("engine", "device") if (value := getattr(job, name)) != "auto"]
        for text in job.overrides:
            words += ["--set", text]
        return shlex.join(words)


def plan_runs(
    table: str, cells: Sequence[Cell], *, seeds: Sequence[int], overrides: Sequence[str], engine: str, device: str
) -> list[Run]:
    """All runs of some cells of a table, seed by seed, so that an unfinished table has about as many of each cell.

    Raises:
        SceneError: If a cell's scene does not exist or its overrides do not fit; the message names the cell.
        ValueError: If an override's ``*`` fits nothing.
    """
    prepared = []
    for cell in cells:
        for name in cell.scenes:
            try:
                changes = spread(warpmpc.load_scene(name), (*cell.overrides, *overrides))
                scene = warpmpc.load_scene(name, overrides=changes)
            except ValueError as error:
                raise ValueError(f"{table}/{cell.name}: {error}") from None
            content = hashlib.sha256(scene.model_dump_json().encode()).hexdigest()[:16]
            prepared.append((cell, name, changes, content))
    return [
        Run(
            table=table,
            cell=cell.name,
            job=Job(scene=name, overrides=changes, seed=seed, engine=engine, device=device, method=cell.method),
            scene_hash=content,
        )
        for seed in seeds
        for cell, name, changes, content in prepared
    ]


class Store:
    """Finished runs, one JSON object a line, in the order they ended.

    Args:
        path: The file; made when the first run is added.
    """

    def __init__(self, path: Path):
        self.path = path
        self.runs: dict[str, dict] = {}
        """Key → record."""
        if path.exists():
            for line in path.read_bytes().splitlines(keepends=True):
                if not line.endswith(b"\n"):
                    break  # cut off in the middle of writing
                record = json.loads(line)
                self.runs[record["key"]] = record

    def add(self, run: Run, record: dict) -> None:
        """Keep a finished run, on disk before this returns."""
        record = {"key": run.key, "cell": run.cell, "scene": run.job.scene, "seed": run.job.seed, **record}
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with open(self.path, "ab+") as file:
            if file.tell() > 0:
                file.seek(-1, os.SEEK_END)
                if file.read() != b"\n":
                    self._mend(file)
            file.write(json.dumps(record, ensure_ascii=False).encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())
        self.runs[run.key] = record

    @staticmethod
    def _mend(file) -> None:
        """Drop a last line that was cut off."""
        file.seek(0)
        file.truncate(file.read().rfind(b"\n") + 1)


def make_runs(
    runs: Sequence[Run], store: Store, *, jobs: int, circumstances: dict, on_done: Callable[[Run, dict], None]
) -> None:
    """Make the runs that the store does not hold yet, and keep each as soon as it ends.

    Args:
        runs: Runs wanted.
        store: Where they are kept.
        jobs: Worker processes.
        circumstances: Kept with every run.
        on_done: Called after each.

    Raises:
        SceneError: If a scene cannot be built.
        ValueError: If the engine or device is unknown or not to be had here.
        BrokenProcessPool: If a worker died.
    """
    missing = [run for run in runs if run.key not in store.runs]
    if not missing:
        return
    with Workers(jobs) as workers:
        futures = {workers.submit(run.job): run for run in missing}
        for future in as_completed(futures):
            run, record = futures[future], future.result()
            store.add(run, {**record, **circumstances, "at": datetime.now(UTC).isoformat(timespec="seconds")})
            on_done(run, record)


def code_digest() -> str:
    """Hash of the code under test, so that a report can tell when its runs come from several states of it."""
    digest = hashlib.sha256()
    folders = [Path(warpmpc.__file__).parent, Path(importlib.util.find_spec("warpmpc.kernels").origin).parent]
    for file in sorted(file for folder in folders for file in folder.rglob("*.py")):
        digest.update(file.name.encode() + file.read_bytes())
    return digest.hexdigest()[:12]
