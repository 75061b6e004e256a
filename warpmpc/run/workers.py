# SPDX-License-Identifier: Apache-2.0
"""Calls spread over processes of this host, one for each of its GPUs, or the machines of a Ray cluster.

Whatever they run on, a call whose process dies is made again elsewhere, up to :data:`TRIES` times in all.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import re
import signal
import threading
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any

from .job import FORMS, GPUS, RAY, TRIES, LostJob, Prepare, Workers
from .ray_workers import RayWorkers

logger = logging.getLogger("warpmpc")

_unprepared: Exception | None = None
"""Error with which this process was prepared."""


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


@dataclass
class _Slot:
    """A process, or rather the pool of one that can be told to start it anew."""

    pool: ProcessPoolExecutor
    gpu: str | None


class LocalWorkers:
    """Processes of this host.

    Each is a pool of its own, so that one that dies takes nobody along and its call is known.

    Args:
        gpus: The GPU that each sees alone, by ``CUDA_VISIBLE_DEVICES``; all see what this process sees if empty.
    """

    def __init__(self, count: int, *, gpus: Sequence[str] = (), prepare: Prepare | None = None):
        self.count = count
        self._prepare, self._closed = prepare, False
        self._context = multiprocessing.get_context("spawn")  # physics and its threads do not survive a fork
        self._theirs, self._ours = self._context.Pipe()  # all processes share their end
        self._idle: SimpleQueue[_Slot] = SimpleQueue()
        for gpu in gpus or [None] * count:
            self._idle.put(_Slot(self._pool(gpu), gpu))
        self._threads = ThreadPoolExecutor(count)

    def __enter__(self) -> LocalWorkers:
        return self

    def __exit__(self, *error: object) -> None:
        # a process that starts ends when the pipe does; one that compiles a kernel would not hear of it for seconds
        self._closed = True
        self._threads.shutdown(wait=False, cancel_futures=True)
        started = set()
        while self._ours.poll():
            started.add(self._ours.recv())
        for process in multiprocessing.active_children():
            if process.pid in started:
                process.kill()
        self._ours.close()

    def submit(self, function: Callable[..., Any], *arguments: object) -> Future[Any]:
        """Queue a call, as :class:`Workers` says."""
        return self._threads.submit(self._call, function, arguments)

    def _pool(self, gpu: str | None) -> ProcessPoolExecutor:
        arguments = (self._theirs, gpu, self._prepare)
        return ProcessPoolExecutor(1, mp_context=self._context, initializer=_start, initargs=arguments)

    def _call(self, function: Callable[..., Any], arguments: tuple[object, ...]) -> Any:
        """Make a call in a process that is idle, and in a new one if that dies."""
        slot = self._idle.get()
        try:
            for _ in range(TRIES):
                try:
                    return slot.pool.submit(_make, function, arguments).result()
                except BrokenProcessPool:
                    if self._closed:
                        raise
                    logger.warning("a worker process died; its job is run again")
                    slot.pool = self._pool(slot.gpu)
            raise LostJob
        finally:
            self._idle.put(slot)


def _start(parent: Connection, gpu: str | None, prepare: Prepare | None) -> None:
    """Prepare a process: it is silent, leaves Ctrl-C to its parent and does not outlive it."""
    global _unprepared
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent.send(os.getpid())
    threading.Thread(target=_follow, args=(parent,), daemon=True).start()
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)  # libraries chat on standard output, from native code, too
    if gpu is not None:
        os.environ["CUDA_VISIBLE_DEVICES"] = gpu  # nothing has looked for GPUs yet
    logger.setLevel(logging.ERROR)  # results count what is warned of
    warnings.simplefilter("ignore")
    if prepare is not None:
        try:
            prepare()
        except Exception as error:  # a pool whose processes fail to start would not say why: each call does
            _unprepared = error


def _make(function: Callable[..., Any], arguments: tuple[object, ...]) -> Any:
    """Make a call in a process that was prepared; raises what kept it from being so."""
    if _unprepared is not None:
        raise _unprepared
    return function(*arguments)


def _follow(parent: Connection) -> None:
    """End this process when its parent has closed its end of a pipe, or has ended, however that came."""
    try:
        parent.recv()
    except (EOFError, OSError):
        os._exit(1)
