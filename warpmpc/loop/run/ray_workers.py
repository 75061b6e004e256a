# SPDX-License-Identifier: Apache-2.0
"""Calls spread over the machines of a Ray cluster, the extra ``cluster``."""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
import socket
import warnings
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from ...scene.origin import code_digest

RAY = "ray"
DIED = "a process of --jobs died, out of memory perhaps; with --results, or --study, the same command goes on"
"""Message on a call whose process died, a ``BrokenProcessPool``."""
CONNECT = 5.0
"""Time that a cluster may take to answer [s]."""
TRIES = 3
"""Attempts at a call whose process or machine is lost each time."""

Prepare = Callable[[], None]
"""Called once in every process, before its first call; a function at the top of a module."""

_prepared = False
"""True if this process has made a call."""


class RayWorkers:
    """A Ray cluster; see :class:`~warpmpc.loop.run.workers.Workers`.

    Ray hands each call a core, and a GPU if asked, keeps processes for the next one, and makes a call again whose
    process or machine is lost. Machines may join while calls wait. Each needs the same warpmpc, and what a call names
    (scene files, assets, files of terms) at the same path.

    Args:
        address: ``HOST:PORT`` of the cluster; ``RAY_ADDRESS`` or the one this host belongs to if empty.
        gpu: Whether each call has a GPU to itself, ``cuda:0``; without, calls see none.

    Raises:
        ValueError: If Ray is not installed, there is no such cluster, or it has no GPU where each call needs one.
    """

    def __init__(self, address: str = "", *, gpu: bool = False, prepare: Prepare | None = None):
        try:
            import ray
        except ImportError:
            raise ValueError(f"--jobs {RAY}: needs the package ray: pip install 'warpmpc[cluster]'") from None
        self._ray, self._opened, self._closed = ray, not ray.is_initialized(), False
        self._replies: set[Any] = set()
        """Calls that are not through."""
        if not self._opened:
            self._require_same(address)
        else:
            address = address or os.environ.get("RAY_ADDRESS") or "auto"
            try:
                if address != "auto":
                    host, _, port = address.rpartition("/")[2].rpartition(":")
                    socket.create_connection((host, int(port)), timeout=CONNECT).close()  # Ray waits for minutes
                with contextlib.chdir("/"):  # Ray puts this folder before the nodes' own packages
                    ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
            except (OSError, ValueError, RuntimeError) as error:
                where = "" if address == "auto" else f" at {address}"
                reason = " ".join(str(error).split())
                raise ValueError(
                    f"--jobs {RAY}: no cluster{where}; start one with 'ray start --head': {reason}"
                ) from None
        kind = "GPU" if gpu else "CPU"
        self.count = int(ray.cluster_resources().get(kind, 0))
        """Cores or GPUs of the cluster when it was joined."""
        if not self.count:
            self.__exit__()
            raise ValueError(f"--jobs {RAY}: the cluster has no {kind}")
        self._gpu, self._prepare, self._code = gpu, prepare, code_digest()
        self._task = ray.remote(num_cpus=1, num_gpus=int(gpu), max_retries=TRIES - 1)(_call)

    def __enter__(self) -> RayWorkers:
        return self

    def __exit__(self, *error: object) -> None:
        self._closed = True
        for reply in list(self._replies):
            self._ray.cancel(reply, force=True)
        if self._opened:
            self._ray.shutdown()  # the cluster goes on, and so does a session that was there before

    def submit(self, function: Callable[..., Any], *arguments: object) -> Future[Any]:
        """Queue a call, as :class:`~warpmpc.loop.run.workers.Workers` says."""
        out: Future[Any] = Future()
        reply = self._task.remote(self._code, self._gpu, pickle.dumps((self._prepare, function, arguments)))
        self._replies.add(reply)
        reply.future().add_done_callback(lambda done: self._hand_over(reply, done, out))
        return out

    def _require_same(self, address: str) -> None:
        """Refuse another cluster than the one that this program has joined by itself."""
        joined = self._ray.get_runtime_context().gcs_address
        if address not in ("", "auto") and not _same_place(address, joined):
            raise ValueError(f"--jobs {RAY}: this program has joined the cluster at {joined}, not the one at {address}")

    def _hand_over(self, reply: Any, done: Future[Any], out: Future[Any]) -> None:
        """Return Ray's result of a call as a plain future."""
        self._replies.discard(reply)
        if self._closed:
            out.cancel()
            return
        errors, error = self._ray.exceptions, done.exception()
        if error is None:
            out.set_result(done.result())
        elif isinstance(error, errors.RayTaskError):
            out.set_exception(error.cause)
        elif isinstance(error, (errors.WorkerCrashedError, errors.NodeDiedError, errors.OutOfMemoryError)):
            out.set_exception(BrokenProcessPool(DIED))
        else:
            out.set_exception(ValueError(f"--jobs {RAY}: {str(error).splitlines()[0]}"))


def _same_place(one: str, other: str) -> bool:
    """Return whether two ``HOST:PORT`` are the same, whichever of its names a host goes by."""
    (host, _, port), (other_host, _, other_port) = (a.rpartition("/")[2].rpartition(":") for a in (one, other))
    try:
        hosts = {socket.gethostbyname(name) for name in (host, other_host)}
    except OSError:
        return one == other
    own = {"127.0.0.1", socket.gethostbyname(socket.gethostname())}
    return port == other_port and (len(hosts) == 1 or hosts <= own)


def _call(code: str, gpu: bool, call: bytes) -> Any:
    """Make a call in a process of the cluster.

    Args:
        code: Digest of the sources of the program that asks.
        gpu: Whether this process may use a GPU.
        call: How to prepare this process, the function and its arguments; read once the sources are known to fit.

    Raises:
        ValueError: If this machine has other sources of warpmpc.
    """
    global _prepared
    if not _prepared and code_digest() != code:
        raise ValueError(f"--jobs {RAY}: {socket.gethostname()} has other sources of warpmpc than this machine")
    prepare, function, arguments = pickle.loads(call)
    if not _prepared:
        if not gpu:
            os.environ["CUDA_VISIBLE_DEVICES"] = ""
        logging.getLogger("warpmpc").setLevel(logging.ERROR)  # results count what is warned of
        warnings.simplefilter("ignore")
        if prepare is not None:
            prepare()
        _prepared = True
    return function(*arguments)
