# SPDX-License-Identifier: Apache-2.0
"""Launches on one device, and fixed sequences of them that are captured once and replayed."""

from __future__ import annotations

import ctypes
import functools
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from typing import TypeVar

import warp as wp
import warp._src.context

from . import kernel_cache

kernel_cache.watch()

capturing = threading.RLock()
"""Held while launches are recorded: a recording takes in whatever any thread of the process launches or copies then.
Whatever else uses Warp in warpmpc, apart from replays, takes it, too; so must a program that uses Warp in other threads
while a controller makes its first two plans."""
os.register_at_fork(before=capturing.acquire, after_in_parent=capturing.release, after_in_child=capturing.release)
Method = TypeVar("Method", bound=Callable)


def one_thread(method: Method) -> Method:
    """Refuse a call of a method while another thread is in a method of the same object's; no thread waits.

    The object has a ``threading.RLock`` in ``_in_use``.
    """

    @functools.wraps(method)
    def guarded(self: object, *args: object, **options: object) -> object:
        if not self._in_use.acquire(blocking=False):
            raise RuntimeError(
                f"another thread uses this {type(self).__name__} now: give each thread its own, "
                "or let one thread call it"
            )
        try:
            return method(self, *args, **options)
        finally:
            self._in_use.release()

    return guarded


def unrecorded(method: Method) -> Method:
    """Let a method run while nothing is recorded; it may not wait for other threads that record."""

    @functools.wraps(method)
    def alone(*args: object, **options: object) -> object:
        with capturing:
            return method(*args, **options)

    return alone


@unrecorded
def assign(array: wp.array, values: object) -> None:
    """Write values into an array."""
    array.assign(values)


@contextmanager
def default_device(device: wp.DeviceLike) -> Iterator[None]:
    """Make a device Warp's default for a while, for libraries that take no device.

    The default is the whole process's: threads that changed it at once could leave it changed for good.
    """
    with capturing, wp.ScopedDevice(device):
        yield


class Launcher:
    """Launches kernels on one device.

    Args:
        device: Warp device.
    """

    def __init__(self, device: wp.DeviceLike):
        self.device = wp.get_device(device)

    def __call__(
        self,
        kernel: wp.Kernel,
        dim: int | Sequence[int],
        inputs: Sequence,
        outputs: Sequence,
        *,
        block_dim: int = 0,
        threads: int = 256,
    ) -> None:
        """Launch a kernel; capture-safe.

        Args:
            kernel: Kernel.
            dim: Threads, or blocks if ``block_dim`` is given.
            inputs: Arguments that are read.
            outputs: Arguments that are written.
            block_dim: Threads in a block of a kernel that works in blocks.
            threads: Threads in a block of any other kernel.
        """
        with capturing:
            if not block_dim:
                wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device, block_dim=threads)
                return
            blocks = [dim] if isinstance(dim, int) else list(dim)
            wp.launch_tiled(kernel, dim=blocks, inputs=inputs, outputs=outputs, block_dim=block_dim, device=self.device)


def step_lanes(steps: int, device: wp.DeviceLike) -> int:
    """Number of threads that share the steps of a world: as many as there are on a GPU, one on the CPU.

    A kernel's arguments are loaded anew for every thread, which on the CPU takes as long as many a step's work.
    """
    return steps if wp.get_device(device).is_cuda else 1


def replay_address() -> int:
    """Address of the native function that replays a recorded sequence on the calling thread.

    ``wp.capture_launch`` calls it, too; Warp does not give it a public name.
    """
    return ctypes.cast(warp._src.context.runtime.core.wp_apic_cpu_replay_state, ctypes.c_void_p).value


class CapturedLaunches:
    """A fixed sequence of launches that costs no Python when it is repeated.

    The first call runs the sequence as it is, which loads its kernels. The second records it as a graph, and from then
    on it is replayed: a launch from Python takes 30 to 50 µs, one in a replayed graph less than 1. Threads may replay
    different sequences at once; recordings wait for each other.

    Args:
        sequence: Launches with the same arguments at every call; nothing else may happen in it. Its arrays must be held
            elsewhere: a recorded launch does not hold them.
        blocks: Whether it launches kernels that work in blocks. On the CPU Warp keeps one storage for the blocks of a
            module, so that no two threads may run such kernels at once.
        device: Warp device of all of them.
    """

    def __init__(self, sequence: Callable[[], None], *, blocks: bool = False, device: wp.DeviceLike = "cpu"):
        self.sequence: Callable[[], None] | None = sequence
        self._blocks, self._device = blocks, wp.get_device(device)
        self._graph: wp.Graph | None = None
        self._ran = False

    def __call__(self) -> None:
        """Run the sequence."""
        if self._graph is None and not self.record():
            return
        with capturing if self._blocks else nullcontext():
            wp.capture_launch(self._graph)

    @property
    def address(self) -> int:
        """Address of what :func:`replay_address` replays, once the sequence is recorded."""
        return ctypes.cast(self._graph.apic_state, ctypes.c_void_p).value

    def record(self) -> bool:
        """Make the sequence ready to be replayed; returns False where that took running it."""
        with capturing:
            if not self._ran:
                self.sequence()
                self._ran = True
                return False
            if self._graph is None:
                with wp.ScopedCapture(device=self._device) as capture:
                    self.sequence()
                self._graph = capture.graph
                self.sequence = None  # it may refer to the owner of this object
            return True
