# SPDX-License-Identifier: Apache-2.0
"""Kernels that take seconds to compile, and what is shown meanwhile."""

from __future__ import annotations

import logging
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager

import warp as wp

from .kernel_cache import Cached

logger = logging.getLogger("warpmpc")


def compile_kernel(kernel: wp.Kernel, device: wp.DeviceLike, block_dim: int, what: str) -> None:
    """Compile a kernel's module unless that was done before, and load it.

    While it compiles a terminal shows one line with the seconds; elsewhere the log has a line (DEBUG) before and after.

    Args:
        kernel: Kernel.
        device: Device that it will be launched on.
        block_dim: Threads in a block of its launches.
        what: What it is for, such as a scene's name.
    """
    device = wp.get_device(device)
    threads = block_dim if device.is_cuda else 1  # a CPU's launches have one thread in a block
    if Cached.of(kernel.module, device, threads).intact():
        wp.load_module(kernel.module, device=device, block_dim=threads)
        return
    with _shown(f"compiling {what} for {device}, once"):
        wp.load_module(kernel.module, device=device, block_dim=threads)


@contextmanager
def native_output() -> Iterator[list[str]]:
    """Keep back what is written to standard error, by native code, too.

    Yields:
        Its lines, once it is over.
    """
    lines: list[str] = []
    sys.stderr.flush()
    real = os.dup(2)
    with tempfile.TemporaryFile() as said:
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
        with Progress(*columns, console=Console(stderr=True), transient=True) as line:
            line.add_task(text, total=None)
            yield
    else:
        logger.debug("%s", text)
        yield
    logger.debug("%s: %.1f s", text, time.perf_counter() - begin)
