# SPDX-License-Identifier: Apache-2.0
"""Calls spread over processes of this host, one for each of its GPUs, or the machines of a Ray cluster.

Files of finished jobs, so that none is run twice and a series that was interrupted goes on.
"""

from __future__ import annotations

import hashlib
import json
import logging
import multiprocessing
import os
import re
import signal
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import connection
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from ...physics.runtime.files import append_line
from ...scene.model.assets import resolve_asset
from ...scene.model.compiled import files_of
from ...scene.origin import code_digest
from .ray_workers import RAY, Prepare, RayWorkers
from .result import EpisodeResult

if TYPE_CHECKING:
    from ...scene.schema import Scene

GPUS = "gpus"
FORMS = f"a number of processes, {GPUS}, {RAY} or {RAY}:HOST:PORT"
"""Values of ``--jobs``."""

_prepared = False
"""True if this process has been prepared."""


class Workers(Protocol):
    """Workers that make calls beside this process; leaving the context ends them, whatever they are at."""

    count: int
    """Calls that are made at a time."""

    def __enter__(self) -> Workers:
        """Take the workers for a while."""

    def __exit__(self, *error: object) -> None:
        """End them."""

    def submit(self, function: Callable[..., Any], *arguments: object) -> Future[Any]:
        """Queue a call of a module's function; the future holds what it returns or raises.

        It raises ``BrokenProcessPool`` where a process died.
        """


def check_jobs(where: str) -> None:
    """Refuse a place for jobs that :func:`open_workers` would not understand.

    Raises:
        ValueError: If this is one.
    """
    if not re.fullmatch(rf"0*[1-9]\d*|{GPUS}|{RAY}(:[^\s:]+:\d+)?", where, re.ASCII):
        raise ValueError(f"--jobs must be {FORMS}, not '{where}'")


def open_workers(where: str, *, device: str = "auto", prepare: Prepare | None = None) -> tuple[Workers, str]:
    """Workers at a place, and the device their calls shall plan on.

    Args:
        where: A number of processes on this host; ``gpus``, a process for each GPU of this host; ``ray``, the Ray
            cluster that this host belongs to; or ``ray:HOST:PORT``, another one.
        device: Device that was asked for. On a cluster a CUDA device takes a GPU for each call, anything else none.

    Raises:
        ValueError: If there is no such place, no GPU, or Ray is not installed.
    """
    check_jobs(where)
    if where.isdecimal():
        return LocalWorkers(int(where), prepare=prepare), device
    kind, _, address = where.partition(":")
    if kind == RAY:
        gpu = device.startswith("cuda")
        return RayWorkers(address, gpu=gpu, prepare=prepare), "cuda:0" if gpu else "cpu"
    gpus = _gpus()
    if device not in ("auto", "cuda", "cuda:0"):
        raise ValueError(f"--jobs {GPUS}: each process sees one GPU, cuda:0: leave out --device, not '{device}'")
    if not gpus:
        raise ValueError(f"--jobs {GPUS}: there is no GPU here")
    return LocalWorkers(len(gpus), gpus=gpus, prepare=prepare), "cuda:0"


def one_thread(workers: Workers, overrides: Sequence[str]) -> tuple[str, ...]:
    """Overrides of a scene for one of several calls that share a machine's cores."""
    return (*overrides, "engine.threads=1") if workers.count > 1 else tuple(overrides)


def _gpus() -> list[str]:
    """Names of this host's GPUs as ``CUDA_VISIBLE_DEVICES`` wants them."""
    import warp as wp

    count = wp.get_cuda_device_count()
    visible = os.environ.get("CUDA_VISIBLE_DEVICES", "")
    return [name.strip() for name in visible.split(",") if name.strip()][:count] or [str(i) for i in range(count)]


class LocalWorkers:
    """Processes of this host; one that dies takes all calls along that are not through.

    Args:
        gpus: The GPU that each sees alone, by ``CUDA_VISIBLE_DEVICES``; all see what this process sees if empty.
    """

    def __init__(self, count: int, *, gpus: Sequence[str] = (), prepare: Prepare | None = None):
        self.count, self._prepare = count, prepare
        context = multiprocessing.get_context("spawn")  # physics and its threads do not survive a fork
        names = context.SimpleQueue() if gpus else None
        for gpu in gpus:
            names.put(gpu)
        self._pool = ProcessPoolExecutor(count, mp_context=context, initializer=_start, initargs=(names,))

    def __enter__(self) -> LocalWorkers:
        return self

    def __exit__(self, *error: object) -> None:
        processes = list(self._pool._processes.values())  # in public, kill_workers, from Python 3.14 on
        self._pool.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.kill()

    def submit(self, function: Callable[..., Any], *arguments: object) -> Future[Any]:
        """Queue a call, as :class:`Workers` says."""
        try:
            return self._pool.submit(_make, self._prepare, function, arguments)
        except BrokenProcessPool as error:  # a process died before
            lost: Future[Any] = Future()
            lost.set_exception(error)
            return lost


def _start(gpus: Any) -> None:
    """Begin a process: it is silent, leaves Ctrl-C to its parent and does not outlive it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_follow, args=(multiprocessing.parent_process().sentinel,), daemon=True).start()
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)  # libraries chat on standard output, from native code, too
    if gpus is not None:
        os.environ["CUDA_VISIBLE_DEVICES"] = gpus.get()  # nothing has looked for GPUs yet
    logging.getLogger("warpmpc").setLevel(logging.ERROR)  # results count what is warned of
    warnings.simplefilter("ignore")


def _make(prepare: Prepare | None, function: Callable[..., Any], arguments: tuple[object, ...]) -> Any:
    """Make a call in a process that is prepared; raises what keeps it from being so."""
    global _prepared
    if prepare is not None and not _prepared:
        prepare()
        _prepared = True
    return function(*arguments)


def _follow(parent: int) -> None:
    """End this process when its parent has ended, however that came."""
    connection.wait([parent])
    os._exit(1)


class FinishedJobs:
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
        """Keep a finished job, on disk before this returns.

        Raises:
            Unwritable: If it cannot be written; those of before stay.
        """
        record = {"key": key, **record}
        self.path.parent.mkdir(parents=True, exist_ok=True)
        append_line(self.path, json.dumps(record, ensure_ascii=False).encode())
        self.by_key[key] = record


class KeptResults:
    """Results of a scene's episodes in a file, one JSON object a line.

    A result counts as long as scene, assets, terms, engine, device and the episodes it was planned together with are
    the same.

    Args:
        path: The file; made when the first result is added.
        scene: The scene, before its tasks are drawn.
        term_files: Files of users' cost terms; what they hold counts, not where.
        engine: Engine that was asked for.
        device: Device that was asked for.

    Raises:
        OSError: If a file cannot be read.
        ValueError: If the file holds something else.
    """

    def __init__(self, path: Path, scene: Scene, *, term_files: Sequence[Path] = (), engine: str, device: str):
        self._records = FinishedJobs(path)
        terms = [hashlib.sha256(file.read_bytes()).hexdigest()[:16] for file in term_files]
        self._what = [scene_digest(scene), engine, device, terms]
        self._code = code_digest()
        self.outdated = 0
        """Results found that another state of warpmpc made."""
        self.taken = 0
        """Results found, whose episodes need not be run."""

    def find(self, seeds: Sequence[int]) -> list[EpisodeResult]:
        """Results of episodes that were planned together, or nothing if one is missing."""
        found = [self._records.by_key.get(self._key(seeds, seed)) for seed in seeds]
        if None in found:
            return []
        self.taken += len(found)
        self.outdated += sum(record["code"] != self._code for record in found)
        return [EpisodeResult.from_json(record["result"]) for record in found]

    def add(self, seeds: Sequence[int], result: EpisodeResult) -> None:
        """Keep the result of one of the episodes that were planned together, on disk before this returns."""
        self._records.add(self._key(seeds, result.seed), {"code": self._code, "result": result.to_json()})

    def _key(self, seeds: Sequence[int], seed: int) -> str:
        together = [seeds[0], len(seeds)] if len(seeds) > 1 else None
        return json.dumps([*self._what, together, seed])


def scene_digest(scene: Scene) -> str:
    """Hash of a scene's validated content and of what its assets and files of motions hold, wherever they lie.

    Raises:
        SceneError: If an asset cannot be found.
    """
    digest = hashlib.sha256(scene.model_dump_json().encode())
    for file in (*files_of(scene), *_tried(scene)):
        digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def _tried(scene: Scene) -> Iterator[Path]:
    """Files of what is tried among the samples."""
    base, planner = (scene.path.parent if scene.path else None), scene.planner
    for name in (planner.sequences, *(ancillary.file for ancillary in planner.ancillary)):
        if name is not None:
            yield resolve_asset(name, base=base, key="planner", file=scene.path)
