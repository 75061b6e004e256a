# SPDX-License-Identifier: Apache-2.0
"""Kernels that take seconds to compile, and what is shown meanwhile."""

from __future__ import annotations

import logging
import os
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import TextIO

import warp as wp

from .kernel_cache import Cached

logger = logging.getLogger("warpmpc")
_keeping_back = threading.RLock()


class KernelError(RuntimeError):
    """A kernel that does not compile or cannot be loaded."""


def compile_kernel(kernel: wp.Kernel, device: wp.DeviceLike, block_dim: int, what: str) -> None:
    """Compile a kernel's module unless that was done before, and load it.

    While it compiles a terminal shows one line with the seconds; elsewhere the log has a line (DEBUG) before and after.

    Args:
        kernel: Kernel.
        device: Device that it will be launched on.
        block_dim: Threads in a block of its launches.
        what: What it is for, such as a scene's name.

    Raises:
        KernelError: If it does not compile; what the compiler says is kept back, but for its first error.
        OSError: If Warp's folder of compiled kernels cannot be written.
    """
    device = wp.get_device(device)
    threads = block_dim if device.is_cuda else 1  # a CPU's launches have one thread in a block
    if Cached.of(kernel.module, device, threads).intact():
        wp.load_module(kernel.module, device=device, block_dim=threads)
        return
    said: list[str] = []
    with _shown(f"compiling {what} for {device}, once"):
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
        print(*said, sep="\n", file=sys.stderr)


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


@contextmanager
def _shown(text: str) -> Iterator[None]:
    """Show on stderr that something takes long, if that is a terminal, or else log it."""
    begin = time.perf_counter()
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

        sys.stderr.write("\r")  # a bar may be there already: it is drawn again when there is something to draw
        columns = SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn()
        with _terminal() as file, Progress(*columns, console=Console(file=file), transient=True) as line:
            line.add_task(text, total=None)
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
