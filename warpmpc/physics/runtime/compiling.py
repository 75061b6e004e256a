# SPDX-License-Identifier: Apache-2.0
"""Kernels that take seconds to compile, what is shown meanwhile, and kernels that are compiled beside other work."""

from __future__ import annotations

import importlib
import logging
import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from contextvars import ContextVar
from typing import TextIO

import warp as wp

from .files import plain
from .kernel_cache import ready

PLANNING = {
    **{"engine.clone": 3.0, "planner.splines": 1.4, "planner.weights": 0.4, "planner.proposals": 0.4},
    **{"planner.moments": 0.4, "planner.costs": 0.4, "engine.launch": 0.4, "planner.sampling": 0.3},
    **{"engine.packing": 0.3, "engine.mujoco": 0.2, "engine.thread_pool": 0.1},
    **{"planner.derivatives": 0.6, "planner.feedback": 0.6, "planner.riccati": 0.9},
}
"""Modules of kernels that plans of every scene and its plant use on the CPU, and the time to compile each [s], on a
busy core of an AMD EPYC; those that take longest first."""
RATE = 1.6e-5
"""Time to compile a byte of source on the CPU [s]: median of 600 launches, on two busy cores of an AMD EPYC."""
LONG = 2.0
"""Time to compile from which it is told how long it takes [s]."""
UNOPTIMIZED = {"optimization_level": 0}
"""Options of modules that are compiled soonest."""
WORKERS = 3
"""Most threads that compile beside other work."""

logger = logging.getLogger("warpmpc")
_keeping_back = threading.RLock()
_later: ContextVar[Later | None] = ContextVar("later", default=None)
_headers: threading.Thread | None = None
"""Thread of :func:`prepare_headers`."""


class KernelError(RuntimeError):
    """A kernel that does not compile or cannot be loaded."""


def compile_kernel(kernel: wp.Kernel, device: wp.DeviceLike, block_dim: int, what: str, *, source: str = "") -> None:
    """Compile a kernel's module unless that was done before, and load it.

    While it compiles a terminal shows one line with the seconds; elsewhere the log has a line before and after.

    Args:
        kernel: Kernel.
        device: Device that it will be launched on.
        block_dim: Threads in a block of its launches.
        what: What it is for, such as a scene's name.
        source: Its source, whose length tells how long it takes on a CPU; empty where that is not known.

    Raises:
        KernelError: If it does not compile; what the compiler says is kept back, but for its first error.
        OSError: If Warp's folder of compiled kernels cannot be written.
    """
    device = wp.get_device(device)
    threads = block_dim if device.is_cuda else 1  # a CPU's launches have one thread in a block
    if ready(kernel.module, device, threads):
        wp.load_module(kernel.module, device=device, block_dim=threads)
        return
    if _headers is not None and not device.is_cuda:
        _headers.join()
    said: list[str] = []
    with shown(f"compiling {what} for {device}, once", 0.0 if device.is_cuda else compile_time(source)):
        try:
            with native_output() as said:
                wp.load_module(kernel.module, device=device, block_dim=threads)
        except OSError:
            raise
        except Exception as error:  # of no kind of its own
            logger.debug("%s", "\n".join(said))
            why = next((line.partition("error: ")[2] for line in said if "error: " in line), str(error))
            raise KernelError(f"{what} cannot be compiled for {device}: {why}") from error
    if said:
        print(plain("\n".join(said)), file=sys.stderr)


class Later:
    """Kernels that run without optimization for now, and are compiled with it beside other work."""

    def __init__(self):
        self.modules: list[wp.Module] = []
        """Modules of the optimized kernels."""
        self._thread = threading.Thread(target=self._compile, name="warpmpc compiling")

    def start(self) -> None:
        """Begin to compile in another thread."""
        self._thread.start()

    def join(self) -> None:
        """Wait until they are compiled, if there are any."""
        if self.modules:
            self._thread.join()

    @property
    def ready(self) -> bool:
        """Return whether there were any and they are compiled, as far as they can be."""
        return bool(self.modules) and not self._thread.is_alive()

    def _compile(self) -> None:
        for module in self.modules:
            with suppress(Exception):  # the caller that uses it gets the error
                wp.load_module(module, device="cpu", block_dim=1)


@contextmanager
def quick() -> Iterator[Later]:
    """Let kernels of :func:`compile_made` that are not on disk be compiled for the CPU without optimization.

    That takes a third of the time, and rollouts then take three to four times as long.

    Yields:
        Those whose optimized kernels are missing; nothing is compiled of them before it is started.
    """
    later = Later()
    token = _later.set(later)
    try:
        yield later
    finally:
        _later.reset(token)


def compile_made(
    make: Callable[..., wp.Kernel], options: Mapping[str, object], device: wp.DeviceLike, *rest: object, source: str
) -> wp.Kernel:
    """Make a kernel and compile it, inside of :func:`quick` without optimization unless it is on disk.

    Args:
        make: Makes it, from ``options`` of its module.
        options: Options of its module.
        device: Device of its launches.
        rest: As for :func:`compile_kernel`.
        source: As for :func:`compile_kernel`.

    Raises:
        KernelError: If it does not compile.
        OSError: If Warp's folder of compiled kernels cannot be written.
    """
    kernel, device, later = make(options=options), wp.get_device(device), _later.get()
    if later is not None and device.is_cpu and not ready(kernel.module, device, 1):
        later.modules.append(kernel.module)
        kernel = make(options={**options, **UNOPTIMIZED})
    compile_kernel(kernel, device, *rest, source=source)
    return kernel


def compile_time(source: str) -> float:
    """Likely time to compile source on a CPU [s]; tables take hardly any time."""
    return RATE * sum(len(line) for line in source.splitlines() if not line.startswith("static const"))


@contextmanager
def native_output() -> Iterator[list[str]]:
    """Keep back what is written to standard error, by native code, too; one thread at a time.

    Yields:
        Its lines, once it is over.
    """
    lines: list[str] = []
    with _keeping_back, tempfile.TemporaryFile() as said:
        sys.stderr.flush()
        real = os.dup(2)
        os.dup2(said.fileno(), 2)
        try:
            yield lines
        finally:
            sys.stderr.flush()
            os.dup2(real, 2)
            os.close(real)
            said.seek(0)
            lines += said.read().decode(errors="replace").splitlines()


def compile_beside() -> float:
    """Begin to compile the kernels of :data:`PLANNING` in other threads, as far as they are not on disk.

    A launch of one that is not ready yet waits for it (:mod:`~warpmpc.physics.runtime.kernel_cache`).

    Returns:
        About how long it takes [s]; 0 where all are on disk.
    """
    cpu = wp.get_device("cpu")
    modules = {importlib.import_module(f"warpmpc.kernels.{name}").__name__: each for name, each in PLANNING.items()}
    missing = {name: each for name, each in modules.items() if not ready(wp.get_module(name), cpu, 1)}
    threads = min(len(missing), WORKERS, max(1, (os.cpu_count() or 1) - 1))
    waiting, taking = iter(missing), threading.Lock()

    def work() -> None:
        while threading.main_thread().is_alive():  # a program that ends waits for one module, not for all
            with taking:
                name = next(waiting, None)
            if name is None:
                return
            with suppress(Exception):  # the launch gets the error
                wp.load_module(name, device=cpu, block_dim=1)

    for _ in range(threads):
        threading.Thread(target=work, name="warpmpc compiling").start()
    return sum(missing.values()) / max(1, threads)


def prepare_headers(options: Mapping[str, object]) -> None:
    """Begin to compile the headers of a source on the CPU in another thread, unless that was done on this machine.

    :func:`compile_kernel` waits for it: together they take longer than one after the other.

    Args:
        options: Options of the modules that the headers are for.
    """
    global _headers

    @wp.kernel(module="unique", enable_backward=False, module_options=dict(options))
    def empty_kernel(nothing: int): ...

    module, cpu = empty_kernel.module, wp.get_device("cpu")
    if ready(module, cpu, 1):
        return

    def work() -> None:
        with suppress(Exception):  # compiling gets the error
            wp.load_module(module, device=cpu, block_dim=1)

    _headers = threading.Thread(target=work, name="warpmpc compiling")
    _headers.start()


@contextmanager
def shown(text: str, seconds: float = 0.0) -> Iterator[None]:
    """Show on stderr that something takes long, if that is a terminal, or else log it.

    Args:
        text: What takes long.
        seconds: How long it is likely to take [s]; 0 where that is not known.
    """
    text += f", about {seconds:.0f} s" if seconds >= LONG else ""
    begin = time.perf_counter()
    if getattr(sys.stderr, "rich_proxied_file", sys.stderr).isatty():  # of a bar that is there already
        from rich.console import Console
        from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

        sys.stderr.write("\r")  # a bar is drawn again when there is something to draw
        columns = SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn()
        with _terminal() as file, Progress(*columns, console=Console(file=file), transient=True) as line:
            line.add_task(plain(text), total=None)
            yield
    else:
        logger.debug("%s", text)
        yield
    logger.debug("%s: %.1f s", text, time.perf_counter() - begin)


def _terminal() -> TextIO | nullcontext[TextIO]:
    """Standard error, also while it is kept back."""
    try:
        return os.fdopen(os.dup(sys.stderr.fileno()), "w", encoding=sys.stderr.encoding)
    except OSError:  # it is no file
        return nullcontext(sys.stderr)
