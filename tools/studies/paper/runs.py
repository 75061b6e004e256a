# SPDX-License-Identifier: Apache-2.0
"""The runs of a table: which there are to make, which are made already."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass, replace
from datetime import UTC, datetime

from shared.jobs import Job, submit

import warpmpc
from warpmpc.cli.setup import start_warp
from warpmpc.extras.tuning.space import present
from warpmpc.loop.run.workers import FinishedJobs, open_workers, scene_digest
from warpmpc.scene.overrides import parse_override

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
        words = ["warpmpc", "run", job.scene, "--seed", str(job.seed)]
        words += [f"--{name}={value}" for name in ("engine", "device") if (value := getattr(job, name)) != "auto"]
        for text in job.overrides:
            words += ["--set", text]
        return shlex.join(words)


def spread(scene: warpmpc.Scene, overrides: Sequence[str]) -> tuple[str, ...]:
    """Overrides whose ``*`` stands only for entries that have the key, so that ``cost.*.metric`` skips other terms.

    Raises:
        ValueError: If no entry has the key.
        SceneError: If a key or value cannot be read.
    """
    out = []
    for text in overrides:
        key, _ = parse_override(text)
        if "*" not in key:
            out.append(text)
            continue
        name, _, value = text.partition("=")
        if not (keys := present(scene, name)):
            raise ValueError(f"--set {text}: no entry of {scene.name} has this key")
        out += [f"{full}={value}" for full in keys]
    return tuple(out)


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
            prepared.append((cell, name, changes, scene_digest(scene)))
    return [
        Run(
            table=table,
            cell=cell.name,
            job=Job(scene=name, overrides=changes, seed=seed, engine=engine, device=device),
            scene_hash=content,
        )
        for seed in seeds
        for cell, name, changes, content in prepared
    ]


def make_runs(
    runs: Sequence[Run],
    records: FinishedJobs,
    *,
    jobs: str,
    device: str,
    circumstances: dict,
    on_done: Callable[[Run, dict], None],
) -> None:
    """Make the runs that are not recorded yet, and record each as soon as it ends.

    Args:
        runs: Runs wanted.
        records: Where they are kept.
        jobs: Where they are made, as for :func:`warpmpc.loop.run.workers.open_workers`.
        device: Device that was asked for.
        circumstances: Kept with every run.
        on_done: Called after each.

    Raises:
        SceneError: If a scene cannot be built.
        ValueError: If the place, the engine or the device is unknown or not to be had here.
        BrokenProcessPool: If a process of the jobs died.
    """
    missing = [run for run in runs if run.key not in records.by_key]
    if not missing:
        return
    workers, device = open_workers(jobs, device=device, prepare=start_warp)
    with workers:
        futures = {submit(workers, replace(run.job, device=device)): run for run in missing}
        for future in as_completed(futures):
            run, record = futures[future], future.result()
            kept = {"cell": run.cell, "scene": run.job.scene, "seed": run.job.seed, **record, **circumstances}
            kept |= {"jobs": workers.count, "at": datetime.now(UTC).isoformat(timespec="seconds")}
            records.add(run.key, kept)
            on_done(run, record)
