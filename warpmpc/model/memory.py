# SPDX-License-Identifier: Apache-2.0
"""Amount of memory, and an error in place of a machine that swaps or kills."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

import warp as wp

from ..scene.errors import SceneError

CGROUP = Path("/sys/fs/cgroup")
"""Where Linux says what a container may use."""


def free_memory(device: wp.DeviceLike) -> int:
    """Bytes that can still be allocated on a device."""
    device = wp.get_device(device)
    if device.is_cuda:
        return device.free_memory
    found = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    with contextlib.suppress(OSError, ValueError, IndexError):
        lines = Path("/proc/meminfo").read_text().splitlines()
        found += [1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    with contextlib.suppress(OSError, ValueError):
        most, used = (int((CGROUP / name).read_text()) for name in ("memory.max", "memory.current"))
        found += [most - used + _page_cache()]
    return min(found)


def _page_cache() -> int:
    """Bytes of files that a container has read and not used since: its own, but given up when memory is short."""
    with contextlib.suppress(OSError, ValueError):
        for line in (CGROUP / "memory.stat").read_text().splitlines():
            name, _, value = line.partition(" ")
            if name == "inactive_file":
                return int(value)
    return 0


def require_memory(needed: int, device: wp.DeviceLike, what: str, *, key: str, cure: str) -> None:
    """Refuse what does not fit.

    Args:
        needed: Bytes.
        device: Where they would be allocated.
        what: What they are for.
        key: Key of the scene that they grow with.
        cure: What to do about it.

    Raises:
        SceneError: If there is less; the caller knows the file.
    """
    if needed < 2**26:
        return  # always there, and asking takes longer
    free = free_memory(device)
    if needed > free:
        raise SceneError(f"{what} need {size(needed)} of memory, {size(free)} are free on {device}: {cure}", key=key)


def size(count: float) -> str:
    """A number of bytes as people say it."""
    for unit in ("B", "kB", "MB"):
        if count < 1000.0:
            return f"{count:.3g} {unit}"
        count /= 1000.0
    return f"{count:.3g} GB"
